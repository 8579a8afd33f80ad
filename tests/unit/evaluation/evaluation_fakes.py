"""A small store whose observations spell out its factors, and encoders that pass on what a test wants."""

from pathlib import Path

import numpy as np
import torch
from torch import nn

from repdib_lightning.data.episodes import EpisodeStore
from repdib_lightning.data.schema import FactorSpec
from repdib_lightning.data.writer import EpisodeWriter
from repdib_lightning.records import ActionSpec, ArraySpec, DataSpec

CELLS, VIDEOS, LENGTH = 4, 3, 60
OBSERVATIONS = {"front": ArraySpec((3, 16, 16)), "sensor": ArraySpec((3,), "float32")}
FACTORS = {
    "cell": FactorSpec("endogenous", "categorical", CELLS),
    "lamp": FactorSpec("exogenous", "continuous", 0, 2),
    "time_step": FactorSpec("exogenous", "continuous"),
    "video": FactorSpec("exogenous", "categorical", VIDEOS),
}


def write_store(path: Path, episodes: int = 10, evaluation: int = 8, seed: int = 0, factors=None) -> EpisodeStore:
    """``sensor`` holds (cell, time step, video); ``front`` shows the cell's number as brightness in one corner."""
    generator = np.random.default_rng(seed)
    with EpisodeWriter(
        path,
        rows=episodes * LENGTH,
        episodes=episodes,
        observations=OBSERVATIONS,
        actions=ActionSpec("discrete", 5),
        factors=FACTORS,
    ) as writer:
        for episode in range(episodes):
            values = {
                "cell": generator.integers(CELLS, size=LENGTH),
                "lamp": generator.uniform(size=(LENGTH, 2)),
                "time_step": np.arange(LENGTH) + 60.0 * episode,
                "video": generator.integers(VIDEOS, size=LENGTH),
            } | {name: make(episode) for name, make in (factors or {}).items()}
            front = generator.integers(0, 8, size=(LENGTH, 3, 16, 16)).astype(np.uint8)
            front[:, :, :4, :4] = (values["cell"] * 60).astype(np.uint8)[:, None, None, None]
            sensor = np.stack([values["cell"], values["time_step"], values["video"]], axis=1).astype(np.float32)
            writer.add_episode(
                observations={"front": front, "sensor": sensor},
                actions=generator.integers(5, size=LENGTH - 1),
                factors=values,
                evaluation=episode >= episodes - evaluation,
            )
    return EpisodeStore(path)


class FakeEncoder(nn.Module):
    """Applies ``latent(sensor)`` (and ``codes(sensor)``) to the sensor observation."""

    def __init__(self, features, latent, groups=0, codes_per_group=0, codes=None, frame_stack=1):
        super().__init__()
        self.features, self.groups, self.codes_per_group = features, groups, codes_per_group
        self.spec = DataSpec({"sensor": ArraySpec((3 * frame_stack,), "float32")}, None, frame_stack)
        self._latent, self._codes = latent, codes
        self.eval()

    def encode(self, observations):
        return self._latent(observations["sensor"])

    def encode_with_codes(self, observations):
        return self.encode(observations), self._codes(observations["sensor"])


def one_hot_cell(sensor):
    return nn.functional.one_hot(sensor[:, 0].long(), CELLS).float()


def cell_encoder():
    return FakeEncoder(CELLS, one_hot_cell)


def cell_and_video_codes():
    """Group 0 is the cell, group 1 the video, group 2 always the same code."""

    def codes(sensor):
        return torch.stack([sensor[:, 0], sensor[:, 2], torch.zeros(len(sensor))], dim=1).long()

    return FakeEncoder(CELLS, one_hot_cell, groups=3, codes_per_group=8, codes=codes)


def time_encoder():
    return FakeEncoder(2, lambda sensor: torch.stack([sensor[:, 1], torch.ones(len(sensor))], dim=1))


def random_encoder(seed=0):
    generator = torch.Generator().manual_seed(seed)
    return FakeEncoder(16, lambda sensor: torch.randn(len(sensor), 16, generator=generator))
