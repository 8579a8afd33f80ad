"""How much faster does TD3+BC train on latents, each frame encoded once, than end to end; and what memory does it take?

V-D4RL's scale: 84 px, three frames, DrQ-v2's encoder, batches of 256; 100,000 frames in one file. Both ways run as
``finetune td3bc`` runs them, Lightning's loop and the gathering of batches included.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch

from benchmarks.measuring import alternate, resident, seconds
from benchmarks.reporting import claim, machine, table
from repdib_lightning.bottlenecks import RepDIB
from repdib_lightning.data.episodes import EpisodeStore
from repdib_lightning.data.writer import EpisodeWriter
from repdib_lightning.encoders import ConvolutionalEncoder
from repdib_lightning.export.bundle import save_bundle
from repdib_lightning.quiet import quieten_lightning
from repdib_lightning.records import ActionSpec, ArraySpec, DataSpec
from repdib_lightning.rl.offline_options import OfflineOptions
from repdib_lightning.rl.offline_training import OfflineTraining
from repdib_lightning.rl.row_sources import Pictures
from repdib_lightning.rl.transitions import TransitionBatches, Transitions

SIZE, ACTIONS, EPISODE, FEATURES, BATCH, UPDATES = 84, 6, 500, 256, 256, 100_000
ON_LATENTS, END_TO_END = 100, 3
"""Updates of a round."""


def write_store(path: Path, frames: int) -> None:
    """Random pictures, actions and rewards."""
    random = np.random.default_rng(0)
    episodes = frames // EPISODE
    writer = EpisodeWriter(
        path,
        rows=episodes * (EPISODE + 1),
        episodes=episodes,
        observations={"pixels": ArraySpec((3, SIZE, SIZE))},
        actions=ActionSpec("continuous", ACTIONS),
        rewards=True,
    )
    picture = random.integers(256, size=(EPISODE + 1, 3, SIZE, SIZE), dtype=np.uint8)
    with writer:
        for _ in range(episodes):
            writer.add_episode(
                observations={"pixels": picture},
                actions=random.uniform(-1, 1, (EPISODE, ACTIONS)).astype(np.float32),
                rewards=random.uniform(size=EPISODE).astype(np.float32),
                terminations=np.zeros(EPISODE, bool),
                truncations=np.arange(EPISODE) == EPISODE - 1,
            )


def write_bundle(folder: Path) -> None:
    """A RepDIB encoder of the size that the end-to-end agent trains."""
    spec = DataSpec({"pixels": ArraySpec((9, SIZE, SIZE))}, ActionSpec("continuous", ACTIONS), 3, 15)
    bottleneck = RepDIB(FEATURES, groups=16, codes=512, start_step=0)
    bottleneck(torch.randn(1024, FEATURES))  # in training mode: the codebooks start
    save_bundle(folder, ConvolutionalEncoder(spec, features=FEATURES), bottleneck, training={}, data={})


def training(store: Path, bundle: Path | None, hidden: int, steps: int) -> OfflineTraining:
    """What ``finetune td3bc`` builds; with a bundle, every frame is encoded here."""
    sizes: dict[str, Any] = dict.fromkeys(("shift", "features", "channels", "strides", "frame_stack"))
    options = OfflineOptions(
        **sizes,
        agent="td3bc",
        data=store,
        encoder=bundle,
        env="none",
        env_options=None,
        steps=steps,
        seed=0,
        learning_rate=3e-4,
        batch_size=BATCH,
        hidden=hidden,
        copies=1,
        evaluate_every=steps,
        episodes=1,
        film=0,
        device="cpu",
        n_steps=3,
    )
    return OfflineTraining(options)


def updates_of(chosen: OfflineTraining, folder: Path) -> Callable[[], object]:
    """As many updates as its options say."""

    def update() -> None:
        chosen.agent.train()  # random shifts and all: a training leaves it in evaluation mode
        chosen.train(folder)

    return update


def compare(store: Path, bundle: Path, folder: Path, hidden: int, rounds: int) -> tuple[float, float, float]:
    """Seconds of an update end to end, of one on latents, and of encoding the store."""
    built: list[OfflineTraining] = []
    encoding = seconds(lambda: built.append(training(store, bundle, hidden, ON_LATENTS)))
    built.append(training(store, None, hidden, END_TO_END))
    names = ("on latents", "end to end")
    for name in names:
        (folder / name).mkdir(exist_ok=True)
    contenders = {name: updates_of(one, folder / name) for name, one in zip(names, built, strict=True)}
    took = alternate(contenders, rounds, warmup=1)
    return took["end to end"] / END_TO_END, took["on latents"] / ON_LATENTS, encoding


def held_by_data(path: Path) -> int:
    """Bytes that reading pictures in batches takes, besides the mapped file."""
    before = resident("RssAnon")
    store = EpisodeStore(path)
    pictures = Pictures(store, DataSpec({"pixels": ArraySpec((9, SIZE, SIZE))}, store.actions_spec, 3))
    batches = TransitionBatches(store, Transitions(store, n_steps=3), pictures, BATCH, UPDATES, 0)
    batch = batches.batch(0)
    held = max(0, resident("RssAnon") - before)
    assert len(batch.actions) == BATCH
    return held


def peak_anonymous(arguments: list[str]) -> int:
    """Bytes of memory that a command of its own holds at its peak, besides files that are mapped (Linux)."""
    child = subprocess.Popen([sys.executable, "-m", "repdib_lightning", *arguments], stdout=subprocess.DEVNULL)
    peak = 0
    while child.poll() is None:
        for line in Path(f"/proc/{child.pid}/status").read_text().splitlines():
            if line.startswith("RssAnon:"):
                peak = max(peak, int(line.split()[1]) * 1024)
        time.sleep(0.1)
    if child.returncode:
        raise SystemExit(f"finetune ended with exit code {child.returncode}")
    return peak


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--frames", type=int, default=100_000)
    parser.add_argument("--rounds", type=int, default=10)
    options = parser.parse_args()
    quieten_lightning()
    print("## Offline agents\n")
    rows, ratios = [], {}
    with tempfile.TemporaryDirectory() as made:
        folder = Path(made)
        store, bundle = folder / "store.h5", folder / "bundle"
        write_store(store, options.frames)
        write_bundle(bundle)
        command = f"finetune td3bc --data {store} --env none --steps 100 --run {folder / 'run'} --overwrite".split()
        peaks = {
            "the data, a batch of pictures at a time": held_by_data(store) / 2**30,
            "training on latents": peak_anonymous([*command, "--encoder", str(bundle)]) / 2**30,
            "training end to end": peak_anonymous(command) / 2**30,
        }
        mapped = store.stat().st_size / 2**30
        for hidden in (256, 1024):
            pictures, latents, encoding = compare(store, bundle, folder, hidden, options.rounds)
            hours = [UPDATES * pictures / 3600, (UPDATES * latents + encoding) / 3600]
            ratios[hidden] = hours[0] / hours[1]
            rows.append([hidden, 1e3 * pictures, 1e3 * latents, encoding, *hours, ratios[hidden]])
    print(
        f"{machine()}. {SIZE} px, three frames, DrQ-v2's encoder, batches of {BATCH}, {options.frames} frames; median "
        f"of {options.rounds} rounds in turn. Hours are of {UPDATES} updates, reckoned from these rounds; those on "
        "latents include encoding every frame once.\n"
    )
    header = ["hidden", "end to end ms", "latents ms", "encoding s", "end to end h", "latents h", "ratio"]
    print(table(header, rows) + "\n")
    print("GiB held: a process's own at the peak, and the file, were all of it mapped at once.\n")
    print(table(["", "own", "file", "both"], [[n, own, mapped, own + mapped] for n, own in peaks.items()]) + "\n")
    for hidden, ratio in ratios.items():
        print(claim(f"end to end, relative to latents, {hidden} hidden units", ratio, at_least=20.0))
    for name, own in peaks.items():
        print(claim(f"GiB: {name}, all of the file included", own + mapped, at_most=3.0))


if __name__ == "__main__":
    main()
