"""How much faster does TD3+BC train on latents, each frame encoded once, than end to end; and what memory does it take?

V-D4RL's scale: 84 px, three frames, DrQ-v2's encoder, batches of 256, 1024 hidden units; 100,000 frames in one file.
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch

from benchmarks.measuring import alternate, resident, seconds
from benchmarks.reporting import claim, machine, table
from repdib_lightning.bottlenecks import RepDIB
from repdib_lightning.data.episodes import EpisodeStore
from repdib_lightning.data.writer import EpisodeWriter
from repdib_lightning.encoders import ConvolutionalEncoder
from repdib_lightning.evaluation.features import encode_rows
from repdib_lightning.export.frozen import FrozenEncoder
from repdib_lightning.records import ActionSpec, ArraySpec, DataSpec
from repdib_lightning.rl.networks import ShiftedPictures, StandardisedLatents
from repdib_lightning.rl.row_sources import Latents, Pictures
from repdib_lightning.rl.td3_bc import TD3BC
from repdib_lightning.rl.transitions import TransitionBatches, Transitions

ACTIONS, EPISODE, UPDATES, FEATURES = 6, 500, 100_000, 256


def write_store(path: Path, frames: int, size: int) -> EpisodeStore:
    """Random pictures, actions and rewards."""
    random = np.random.default_rng(0)
    episodes = frames // EPISODE
    writer = EpisodeWriter(
        path,
        rows=episodes * (EPISODE + 1),
        episodes=episodes,
        observations={"pixels": ArraySpec((3, size, size))},
        actions=ActionSpec("continuous", ACTIONS),
        rewards=True,
    )
    picture = random.integers(256, size=(EPISODE + 1, 3, size, size), dtype=np.uint8)
    with writer:
        for _ in range(episodes):
            writer.add_episode(
                observations={"pixels": picture},
                actions=random.uniform(-1, 1, (EPISODE, ACTIONS)).astype(np.float32),
                rewards=random.uniform(size=EPISODE).astype(np.float32),
                terminations=np.zeros(EPISODE, bool),
                truncations=np.arange(EPISODE) == EPISODE - 1,
            )
    return EpisodeStore(path)


def updates_of(agent: TD3BC, batches: TransitionBatches, count: int) -> Callable[[], None]:
    """Updates from consecutive batches, gathering included."""
    optimizers = agent.configure_optimizers()
    agent.optimizers = lambda **_: optimizers  # type: ignore[method-assign, assignment, return-value]
    numbers = iter(range(10**9))

    def update() -> None:
        for _ in range(count):
            number = next(numbers)
            agent.training_step(batches.batch(number), number)

    return update


def contenders(store: EpisodeStore, hidden: int, strides: list[int]) -> tuple[dict[str, Callable[[], None]], float]:
    """Ten updates on latents and one end to end; and seconds to encode every frame, from a part of them."""
    spec = DataSpec({"pixels": ArraySpec((9, *store.observations["pixels"].shape[1:]))}, store.actions_spec, 3, 15)
    encoder = ConvolutionalEncoder(spec, features=FEATURES, strides=strides)
    bottleneck = RepDIB(FEATURES, groups=16, codes=512, start_step=0)
    bottleneck(torch.randn(1024, FEATURES))  # in training mode: the codebooks start
    bottleneck.eval()
    frozen = FrozenEncoder(encoder, bottleneck, {})
    some = np.arange(512)
    part = seconds(lambda: encode_rows(frozen, store, some, progress=False)) / len(some)
    transitions = Transitions(store, n_steps=3)
    latents = Latents.__new__(Latents)  # encoding is timed on a part; its values do not matter here
    latents.copies = np.random.default_rng(0).standard_normal((1, store.rows, FEATURES)).astype(np.float32)
    latents._place = np.arange(store.rows)
    sizes = {"hidden": hidden, "learning_rate": 3e-4}
    standardised = StandardisedLatents(torch.zeros(FEATURES), torch.ones(FEATURES))
    on_latents = TD3BC(standardised, FEATURES, ACTIONS, **sizes)
    trained = ConvolutionalEncoder(spec, features=FEATURES, strides=strides)
    end_to_end = TD3BC(ShiftedPictures(trained, 4), FEATURES, ACTIONS, **sizes)
    both = {
        "on latents": updates_of(on_latents, TransitionBatches(store, transitions, latents, 256, 1, 0), 10),
        "end to end": updates_of(
            end_to_end, TransitionBatches(store, transitions, Pictures(store, spec), 256, 1, 0), 1
        ),
    }
    return both, part * store.rows


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--frames", type=int, default=100_000)
    parser.add_argument("--rounds", type=int, default=10)
    options = parser.parse_args()
    print("## Offline agents\n")
    rows, ratios = [], {}
    with tempfile.TemporaryDirectory() as folder:
        store = write_store(Path(folder) / "store.h5", options.frames, 84)
        for hidden in (1024, 256):
            both, encoding = contenders(store, hidden, [2, 1, 1, 1])
            took = alternate(both, options.rounds, warmup=1)
            latents, pictures = took["on latents"] / 10, took["end to end"]
            ratios[hidden] = UPDATES * pictures / (UPDATES * latents + encoding)
            hours = [UPDATES * pictures / 3600, (UPDATES * latents + encoding) / 3600]
            rows.append([hidden, 1e3 * pictures, 1e3 * latents, encoding, *hours, ratios[hidden]])
        memory = resident("VmHWM")
    print(
        f"{machine()}. 84 px, three frames, DrQ-v2's encoder, batches of 256, {options.frames} frames; median of "
        f"{options.rounds} rounds in turn. Hours are of {UPDATES} updates; those on latents include encoding every "
        "frame once.\n"
    )
    header = ["hidden", "end to end ms", "latents ms", "encoding s", "end to end h", "latents h", "ratio"]
    print(table(header, rows) + "\n")
    for hidden, ratio in ratios.items():
        print(claim(f"end to end, relative to latents, {hidden} hidden units", ratio, at_least=20.0))
    print(claim("GiB of memory at most, mapped file included", memory / 2**30, at_most=3.0))


if __name__ == "__main__":
    main()
