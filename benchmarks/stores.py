"""Data sets of any size with pictures of noise: speed does not depend on what they show."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from repdib_lightning.data.writer import EpisodeWriter
from repdib_lightning.records import ActionSpec, ArraySpec

ARM = {"front": (3, 64, 64), "top": (3, 64, 64)}
OFFLINE = {"pixels": (3, 84, 84)}


def write(
    path: Path,
    views: dict[str, tuple[int, ...]],
    actions: ActionSpec,
    rows: int,
    episode: int = 500,
    *,
    rewards: bool = False,
) -> Path:
    """Write ``rows`` rows in episodes of about ``episode`` rows, every fifth of which is for evaluation."""
    generator = np.random.default_rng(0)
    noise = {name: generator.integers(0, 256, (episode, *shape), np.uint8) for name, shape in views.items()}
    lengths = [episode] * (rows // episode)
    observations = {name: ArraySpec(shape) for name, shape in views.items()}
    with EpisodeWriter(
        path, rows=sum(lengths), episodes=len(lengths), observations=observations, actions=actions, rewards=rewards
    ) as writer:
        for number, length in enumerate(lengths):
            steps = length - 1
            taken = (
                generator.integers(0, actions.size, steps)
                if actions.kind == "discrete"
                else generator.uniform(-1, 1, (steps, actions.size)).astype(np.float32)
            )
            told = {}
            if rewards:
                ended = np.arange(steps) == steps - 1
                told = {
                    "rewards": np.ones(steps, np.float32),
                    "terminations": ended,
                    "truncations": np.zeros(steps, bool),
                }
            writer.add_episode(observations=noise, actions=taken, evaluation=number % 5 == 4, **told)
    return path
