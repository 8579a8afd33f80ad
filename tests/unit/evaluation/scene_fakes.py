"""Scenes of one bright square whose brightness and place are known; a model that takes them apart and draws them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from torch import nn

from repdib_lightning.bottlenecks import Identity
from repdib_lightning.bottlenecks.base import Bottleneck
from repdib_lightning.data.episodes import EpisodeStore
from repdib_lightning.data.schema import FactorSpec
from repdib_lightning.data.writer import EpisodeWriter
from repdib_lightning.decoders.base import Decoder
from repdib_lightning.encoders.base import Encoder
from repdib_lightning.evaluation.factor_classifier import Judge
from repdib_lightning.export.frozen import FrozenEncoder
from repdib_lightning.records import ArraySpec, BottleneckOutput, DataSpec

SIZE, LENGTH = 16, 12
LEVELS, PLACES = 3, 4
STEP = 80
FACTORS = {
    "brightness": FactorSpec("endogenous", "categorical", LEVELS),
    "coin": FactorSpec("exogenous", "categorical", 2),
    "place": FactorSpec("endogenous", "categorical", PLACES),
}


def paint(levels, places):
    """(n,) and (n,) to (n, 3, 16, 16) uint8: one quarter of the picture is lit."""
    pictures = np.zeros((len(levels), 3, SIZE, SIZE), np.uint8)
    half = SIZE // 2
    for picture, level, place in zip(pictures, levels, places, strict=True):
        y, x = divmod(int(place), 2)
        picture[:, half * y : half * (y + 1), half * x : half * (x + 1)] = STEP * (int(level) + 1)
    return pictures


def write_scenes(path: Path, train: int = 10, held_out: int = 8, seed: int = 0, held_out_seed: int = 1, change=None):
    """Episodes of 12 rows. ``change(split, factors)`` may replace the factors of an episode, before it is painted."""
    draws = {"train": np.random.default_rng(seed), "evaluation": np.random.default_rng(held_out_seed)}
    splits = ["train"] * train + ["evaluation"] * held_out
    with EpisodeWriter(
        path,
        rows=LENGTH * len(splits),
        episodes=len(splits),
        observations={"pixels": ArraySpec((3, SIZE, SIZE))},
        actions=None,
        factors=FACTORS,
        overwrite=True,
    ) as writer:
        for split in splits:
            factors = {name: draws[split].integers(spec.classes, size=LENGTH) for name, spec in FACTORS.items()}
            factors |= {} if change is None else change(split, factors)
            writer.add_episode(
                observations={"pixels": paint(factors["brightness"], factors["place"])},
                factors=factors,
                evaluation=split == "evaluation",
            )
    return EpisodeStore(path)


class SceneEncoder(Encoder):
    """Two groups of two numbers: brightness, 1 to 3, and place, -1 or 1 each way. On a grid of two positions the second
    group holds one way at each of them."""

    def __init__(self, frame_stack: int = 1, grid: bool = False) -> None:
        spec = DataSpec({"pixels": ArraySpec((3 * frame_stack, SIZE, SIZE))}, None, frame_stack)
        super().__init__(spec, 8 if grid else 4)
        self.positions = 2 if grid else 1
        self.unit = nn.Parameter(torch.ones(()))

    def forward(self, observations):
        newest = observations["pixels"][:, -1].float()
        level = newest.amax((1, 2)) / STEP
        rows, columns = newest.amax(2).argmax(1), newest.amax(1).argmax(1)
        y, x = (torch.where(found >= SIZE // 2, 1.0, -1.0) for found in (rows, columns))
        parts = [level, level / 2, x, y] if self.positions == 1 else [level, level / 2, x, x, level, level / 2, y, y]
        return torch.stack(parts, 1) * self.unit


class SceneDecoder(Decoder):
    """Draws what :class:`SceneEncoder` saw, in every frame of a stack."""

    def __init__(self, spec: DataSpec) -> None:
        super().__init__(spec, 4, "pixels")

    def forward(self, latents):
        level, _, x, y = latents.T
        lit = torch.zeros(len(latents), SIZE, SIZE)
        half = SIZE // 2
        for number in range(len(latents)):
            top, left = half * int(y[number] > 0), half * int(x[number] > 0)
            lit[number, top : top + half, left : left + half] = level[number] * STEP / 255.0
        return lit[:, None].expand(-1, self.spec.observations["pixels"].shape[0], -1, -1)


class Named(Bottleneck):
    """Passes (N, 4) or (N, 8) on, and names what it sees: brightness and place, or on a grid brightness and one way."""

    def __init__(self, width: int) -> None:
        super().__init__(width)
        self.groups, self.codes = width // 2, 4

    def forward(self, latent):
        level, sign = latent[:, 0].round().long(), (latent > 0).long()
        if self.width == 4:
            return BottleneckOutput(latent, {}, torch.stack([level, 2 * sign[:, 3] + sign[:, 2]], 1))
        return BottleneckOutput(latent, {}, torch.stack([level, sign[:, 2], level, sign[:, 6]], 1))


def scene_model(quantised: bool = True, frame_stack: int = 1, grid: bool = False):
    encoder = SceneEncoder(frame_stack, grid)
    bottleneck = Named(encoder.features) if quantised else Identity(encoder.features)
    return FrozenEncoder(encoder, bottleneck, {}), SceneDecoder(encoder.spec)


class AllSeeing(Judge):
    """Reads brightness and place off the pixels."""

    def __init__(self, factors):
        super().__init__(None, dict.fromkeys(factors, 1.0))  # type: ignore[arg-type]

    def tell(self, pictures):
        half = SIZE // 2
        quarters = [pictures[:, 0, half * y, half * x] for y in (0, 1) for x in (0, 1)]
        told = {
            "brightness": np.max(quarters, 0).astype(int) // STEP - 1,
            "place": np.argmax(quarters, 0),
            "coin": np.zeros(len(pictures), int),
        }
        return {name: told[name] for name in self.accuracy}
