"""How fast do batches of random pairs (an anchor and one later frame) arrive, and does reading keep memory flat?

Contenders, all with the same rows in the same order unless they sample themselves:

- ours: the training loader of the data module, which gathers through memory maps (the default);
- ours, resident: the same with ``resident``, which keeps the arrays on the training device;
- RAM array: the whole array in memory and one ``np.take`` a batch, with rows that are known: the limit;
- h5py: one read a frame from the same file, in the file's order;
- TorchRL: a replay buffer on its memory-mapped storage, holding transitions (each with its own copy of the next
  picture, so twice the bytes). It stores single pictures here: stacks are left out.

On a GPU each batch counts when it has arrived there.
"""

from __future__ import annotations

import argparse
import itertools
import logging
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import h5py
import lightning.pytorch as pl
import numpy as np
import torch

from benchmarks.measuring import alternate, resident
from benchmarks.reporting import claim, machine, table
from repdib_lightning.allocation import keep_freed_memory
from repdib_lightning.data.datamodule import EpisodeDataModule
from repdib_lightning.data.loading import FutureFrames
from repdib_lightning.data.sampling import stacked_rows
from repdib_lightning.data.writer import EpisodeWriter
from repdib_lightning.records import ArraySpec

SHAPE, BATCH, HORIZON, EPISODE = (3, 84, 84), 256, 5, 250
STACKS = (1, 3)
CALLS = 16
"""Batches of one timed call."""


def write_store(path: Path, rows: int) -> Path:
    """A store of one random block, repeated with another corner for each episode; the last, short one is held out."""
    block = np.random.default_rng(0).integers(0, 256, (2 * EPISODE, *SHAPE), np.uint8)
    count = (rows - HORIZON - 1) // EPISODE
    lengths = [EPISODE] * count + [rows - count * EPISODE]
    with EpisodeWriter(
        path, rows=rows, episodes=len(lengths), observations={"camera": ArraySpec(SHAPE)}, actions=None
    ) as writer:
        for episode, length in enumerate(lengths):
            block[:, 0, 0, 0] = episode % 256
            writer.add_episode(observations={"camera": block[:length]}, evaluation=episode == count)
    return path


def opened(path: Path, stack: int, device: str, keep: bool) -> EpisodeDataModule:
    """The data module as a training has it."""
    data = EpisodeDataModule(str(path), batch_size=BATCH, horizon=HORIZON, frame_stack=stack, resident=keep)
    logging.getLogger("lightning.pytorch").setLevel(logging.ERROR)
    data.trainer = pl.Trainer(accelerator="cpu" if device == "cpu" else "gpu", devices=1, logger=False)
    data.setup("fit")
    return data


class Ours:
    """The training loader, epoch after epoch."""

    def __init__(self, path: Path, stack: int, device: str, keep: bool) -> None:
        self.loader, self.device = opened(path, stack, device, keep).train_dataloader(), device
        self.batches = itertools.chain.from_iterable(itertools.repeat(self.loader))

    def __call__(self) -> torch.Tensor:
        """One batch."""
        return next(self.batches).observations["camera"].to(self.device, non_blocking=True)


def endless_rows(dataset: FutureFrames) -> Iterator[np.ndarray]:
    """The rows that the training loader gathers, a batch at a time."""
    for epoch in itertools.count():
        for first in range(0, len(dataset) - BATCH + 1, BATCH):
            numbers = np.arange(first, first + BATCH) + epoch * len(dataset)
            anchors, offsets = dataset.sampling.draw(numbers)
            newest = (anchors[:, None] + offsets).reshape(-1)
            yield stacked_rows(dataset.store, newest, dataset.frame_stack).reshape(-1)


class Taken:
    """The limit: an array in memory, and rows that are drawn before the clock runs."""

    def __init__(self, path: Path, rows: list[np.ndarray], device: str) -> None:
        with h5py.File(path, "r") as file:
            self.array = file["observations/camera"][:]
        self.rows, self.device = itertools.cycle(rows), device

    def __call__(self) -> torch.Tensor:
        """One batch."""
        return torch.from_numpy(np.take(self.array, next(self.rows), axis=0)).to(self.device)


class Read:
    """One h5py read a frame, by plain indexing: faster than ``read_direct``, no slower than a list of rows."""

    def __init__(self, path: Path, rows: list[np.ndarray], device: str) -> None:
        self.array = h5py.File(path, "r")["observations/camera"]
        self.rows, self.device = itertools.cycle(rows), device

    def __call__(self) -> torch.Tensor:
        """One batch."""
        rows = next(self.rows)
        frames = np.empty((len(rows), *SHAPE), np.uint8)
        for place in np.argsort(rows, kind="stable"):
            frames[place] = self.array[rows[place]]
        return torch.from_numpy(frames).to(self.device)


class Replayed:
    """TorchRL's replay buffer; raises ImportError where it is not installed."""

    def __init__(self, folder: Path, rows: int, device: str) -> None:
        from tensordict import TensorDict
        from torchrl.data import LazyMemmapStorage, TensorDictReplayBuffer

        self.buffer = TensorDictReplayBuffer(storage=LazyMemmapStorage(rows, scratch_dir=folder), batch_size=BATCH)
        block = torch.randint(256, (EPISODE + 1, *SHAPE), dtype=torch.uint8)
        for first in range(0, rows, EPISODE):
            count = min(EPISODE, rows - first)
            pairs = {"pixels": block[:count], "next": {"pixels": block[1 : count + 1]}}
            self.buffer.extend(TensorDict(pairs, batch_size=[count]))
        self.device = device

    def __call__(self) -> tuple[torch.Tensor, torch.Tensor]:
        """One batch."""
        sample = self.buffer.sample()
        return sample["pixels"].to(self.device), sample["next", "pixels"].to(self.device)


def several(call: Callable[[], object]) -> None:
    """Batches one after the other, of which none is kept."""
    for _ in range(CALLS):
        call()


def check_same(path: Path, stack: int, rows: list[np.ndarray]) -> None:
    """Ours, kept or not, deliver the frames that the others read."""
    taken = Taken(path, rows, "cpu")
    ours = [Ours(path, stack, "cpu", keep) for keep in (False, True)]
    for _ in range(3):
        wanted = taken().reshape(BATCH, 2, -1, *SHAPE[1:])
        assert all(torch.equal(batch(), wanted) for batch in ours)


def measure(path: Path, stack: int, options: argparse.Namespace, replayed: Replayed | None) -> dict[str, float]:
    """Frames a second of each contender, after one pass over the file through the memory map."""
    mapped, kept = (Ours(path, stack, options.device, keep) for keep in (False, True))
    dataset = mapped.loader.dataset
    rows = list(itertools.islice(endless_rows(dataset), (options.rounds + 2) * CALLS))
    check_same(path, stack, rows)
    for _ in range(len(mapped.loader)):
        mapped()
    single: dict[str, Callable[[], object]] = {
        "ours": mapped,
        "ours, resident": kept,
        "RAM array": Taken(path, rows, options.device),
        "h5py": Read(path, rows, options.device),
    }
    if replayed is not None and stack == 1:
        single["TorchRL"] = replayed
    contenders = {name: lambda call=call: several(call) for name, call in single.items()}
    took = alternate(contenders, options.rounds, device=options.device)
    return {name: CALLS * BATCH * 2 * stack / took[name] for name in single}


def reading_everything(path: Path) -> tuple[int, float, float]:
    """Read the whole store in random order through the default path, which nothing has read before in this process.

    Returns:
        by how many bytes this process's own memory grew at most, a batch in hand; the share of the rows that were
        read; frames a second.
    """
    data = EpisodeDataModule(str(path), batch_size=BATCH, horizon=1)  # every row is an anchor, or follows one
    data.setup("fit")
    seen = np.zeros(data.store.rows, bool)
    loader = data.train_dataloader()
    before, highest, frames, start = resident("RssAnon"), 0, 0, time.perf_counter()

    # The second epoch, in another order, reads what was left out as the first one's incomplete batch.
    for batch in itertools.chain(loader, loader, data.val_dataloader()):
        frames += batch.offsets.numel()
        seen[(batch.rows[:, None] + batch.offsets).numpy()] = True
        highest = max(highest, resident("RssAnon"))
        del batch  # before the next one is made
    return highest - before, float(seen.mean()), frames / (time.perf_counter() - start)


def main() -> None:
    """Print the table and the claims."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--threads", type=int, default=torch.get_num_threads())
    parser.add_argument("--rows", type=int, default=20_000)
    parser.add_argument("--rounds", type=int, default=20)
    parser.add_argument("--keep_memory", action="store_true", help="as the command line does, see allocation.py")
    options = parser.parse_args()
    torch.set_num_threads(options.threads)
    if options.keep_memory:
        assert keep_freed_memory(), "needs glibc"
    with tempfile.TemporaryDirectory() as folder:
        path = write_store(Path(folder) / "pairs.h5", options.rows)
        size = options.rows * int(np.prod(SHAPE))
        growth, share, first_pass = reading_everything(path)
        try:
            replayed, note = Replayed(Path(folder) / "replayed", options.rows, options.device), ""
        except ImportError as error:
            replayed, note = None, f" TorchRL is left out: {error}."
        results = {stack: measure(path, stack, options, replayed) for stack in STACKS}
    print("## Random pairs from a file\n")
    print(
        f"{machine(options.device)}. {options.rows} rows of {'x'.join(map(str, SHAPE))} ({size >> 20} MiB, in the page"
    )
    print(f"cache), batch {BATCH}. Median of {options.rounds} alternated calls of {CALLS} batches each.{note}\n")
    rows = [
        [stack, name, speed, speed / speeds["RAM array"]]
        for stack, speeds in results.items()
        for name, speed in speeds.items()
    ]
    print(table(["frame_stack", "path", "frames/s", "/ RAM array"], rows) + "\n")
    for stack, speeds in results.items():
        print(claim(f"ours / RAM array, frame_stack {stack}", speeds["ours"] / speeds["RAM array"], at_least=0.6))
    what = f"own memory's growth over reading {share:.1%} of the rows in random order, share of the store"
    print(claim(f"{what} ({growth >> 20} MiB)", growth / size, at_most=0.05))
    print(f"  (that first pass, which maps the file's pages: {first_pass:.0f} frames/s)")


if __name__ == "__main__":
    main()
