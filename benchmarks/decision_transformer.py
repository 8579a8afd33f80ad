"""How much faster does a Decision Transformer learn on latents than end to end, and in how much memory?

The same windows of the same recording, once through the frozen encoder, once as pictures through an encoder that is
trained along, each as ``finetune dt`` in a process of its own. An epoch is what lies between the ends of two; some
updates of it are timed.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

import torch
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from benchmarks import stores
from benchmarks.reporting import claim, machine, table
from repdib_lightning.bottlenecks import Identity
from repdib_lightning.data.episodes import EpisodeStore
from repdib_lightning.encoders import ConvolutionalEncoder
from repdib_lightning.evaluation.features import stacked
from repdib_lightning.export.bundle import save_bundle
from repdib_lightning.records import ActionSpec, DataSpec
from repdib_lightning.rl.decision_transformer.windows import Windows

VIEWS, STACK, CONTEXT, STRIDE = {"frame": (1, 84, 126)}, 4, 30, 10
CONVOLUTIONS = {"channels": [32, 64, 64], "kernels": [8, 4, 3], "strides": [4, 2, 1]}
SIZES = {"3 layers, width 64": (3, 4, 64, 64), "6 layers, width 128 (published)": (6, 8, 128, 128)}
"""Name -> layers, heads, width, windows an update."""


@dataclass(frozen=True)
class Measured:
    """Of one training: seconds of an epoch, of the command until its first update, and its largest memory in GB."""

    epoch: float
    before: float
    memory: float


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rows", type=int, default=100_000)
    parser.add_argument(
        "--updates", type=int, default=8, help="of an epoch that is timed; five times as many on latents"
    )
    parser.add_argument("--rounds", type=int, default=3, help="in which all ways take turns; the best of each counts")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        data = folder / "store.h5"
        stores.write(data, VIEWS, ActionSpec("discrete", 4), rows=options.rows, episode=1000, rewards=True)
        encoder = make_encoder(data, folder / "bundle")
        windows = len(Windows(EpisodeStore(data), CONTEXT, STRIDE))
        found: dict[tuple[str, str], list[Measured]] = {}
        for number in range(options.rounds):
            for size, (layers, heads, width, batch) in SIZES.items():
                words = ["--layers", layers, "--heads", heads, "--width", width, "--batch_size", batch]
                words += ["--context", CONTEXT, "--stride", STRIDE]
                for way, given, more in (("on latents", ["--encoder", encoder], 5), ("end to end", [], 1)):
                    run, updates = folder / f"{number}-{layers}-{way.split()[-1]}", more * options.updates
                    measured = measure(run, [*words, *given], data, updates, windows / batch / updates)
                    found.setdefault((size, way), []).append(measured)
        report(options.rows, windows, {which: best(rounds) for which, rounds in found.items()}, options.rounds)


def make_encoder(data: Path, bundle: Path) -> Path:
    """A bundle of the convolutions that the transformer trains end to end; what it has learned costs no time."""
    torch.manual_seed(0)
    store = EpisodeStore(data)
    seen = {name: stacked(array, STACK) for name, array in store.observations.items()}
    encoder = ConvolutionalEncoder(DataSpec(seen, store.actions_spec, STACK), features=128, **CONVOLUTIONS)
    save_bundle(bundle, encoder, Identity(128), training={}, data={})
    return bundle


def measure(run: Path, words: list[object], data: Path, updates: int, an_epoch: float) -> Measured:
    """Train two short epochs in a process of its own; the time between their ends, times ``an_epoch``."""
    command = [sys.executable, "-m", "benchmarks.decision_transformer_run", "finetune", "dt", "--data", data, *words]
    command += ["--run", run, "--epochs", 2, "--steps_per_epoch", updates, "--env", "none", "--device", "cpu"]
    began = time.time()
    done = subprocess.run([str(word) for word in command], check=True, stdout=subprocess.PIPE, text=True)
    memory = float(done.stdout.strip().splitlines()[-1])
    events = EventAccumulator(str(run)).Reload().Scalars("train/loss")
    first, second = (event.wall_time for event in events)
    return Measured((second - first) * an_epoch, first - (second - first) - began, memory)


def best(rounds: list[Measured]) -> Measured:
    """The least time of each kind: what else the machine does can only add to it. The most memory."""
    epoch, before = min(one.epoch for one in rounds), min(one.before for one in rounds)
    return Measured(epoch, before, max(one.memory for one in rounds))


def report(rows: int, windows: int, found: dict[tuple[str, str], Measured], rounds: int) -> None:
    """The table and what was asked for."""
    print("## Decision Transformer\n")
    pictures = "x".join(map(str, VIEWS["frame"][1:]))
    print(
        f"{machine()}. {rows:,} transitions of {pictures} pixels, stacks of {STACK}; an epoch: {windows:,} windows of "
        f"{CONTEXT} steps, {STRIDE} apart. Convolutions: DQN's. Encoding the data once is in the time before the first "
        f"update. Best of {rounds} rounds, in which all four take turns.\n"
    )
    lines, ratios = [], {}
    for size in SIZES:
        latents, whole = found[size, "on latents"], found[size, "end to end"]
        ratios[size] = whole.epoch / latents.epoch
        five = (whole.before + 5 * whole.epoch) / (latents.before + 5 * latents.epoch)
        for way, one in (("on latents", latents), ("end to end", whole)):
            told = [f"{ratios[size]:.1f}", f"{five:.1f}"] if one is latents else ["", ""]
            lines.append([size, way, one.before, one.epoch, one.memory, *told])
    head = [
        "transformer",
        "",
        "s before the first update",
        "s an epoch",
        "GB of memory",
        "times faster",
        "with 5 epochs and encoding",
    ]
    print(table(head, lines) + "\n")
    print(claim("times faster on latents, " + next(iter(SIZES)), ratios[next(iter(SIZES))], at_least=10.0))
    print(claim("GB of memory on latents", max(found[size, "on latents"].memory for size in SIZES), at_most=2.0))


if __name__ == "__main__":
    main()
