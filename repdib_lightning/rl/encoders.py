"""Where an agent's encoder comes from: a bundle, or a fresh one of the same kind."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import gymnasium
import numpy as np
from torch import nn

from repdib_lightning.bottlenecks import Identity
from repdib_lightning.encoders import ConvolutionalEncoder
from repdib_lightning.errors import UserError
from repdib_lightning.export.description import bundle_config
from repdib_lightning.export.frozen import FrozenEncoder
from repdib_lightning.records import ArraySpec, DataSpec
from repdib_lightning.rl.features import BottleneckFeatures

FRESH_FEATURES, FRESH_CHANNELS, FRESH_STRIDES = 128, 16, (3, 2)
"""Of a fresh encoder unless chosen: those of the mazes' pre-training."""

PICTURE = "picture"
"""Name of the observation where an environment gives a bare array."""


def fresh_description(
    space: gymnasium.Space[Any],
    features: int | None = None,
    channels: int | None = None,
    strides: Sequence[int] | None = None,
) -> dict[str, Any]:
    """Describe a :class:`ConvolutionalEncoder` without a bottleneck for an environment's pictures.

    Args:
        space: of the environment's observations.
        features, channels, strides: of the encoder; by default those of the mazes' pre-training.

    Raises:
        UserError: no picture, one too small for the strides, or sizes out of range.
    """
    named = dict(space.spaces) if isinstance(space, gymnasium.spaces.Dict) else {PICTURE: space}
    arrays = {name: ArraySpec(_channels_first(part)) for name, part in named.items() if _is_picture(part)}
    if not arrays:
        raise UserError(f"--env: gives no picture (uint8, height x width x channels) but {space}")
    width = FRESH_FEATURES if features is None else features
    encoder = ConvolutionalEncoder(
        DataSpec(arrays),
        features=width,
        channels=FRESH_CHANNELS if channels is None else channels,
        strides=list(FRESH_STRIDES if strides is None else strides),
    )
    return bundle_config(encoder, Identity(width), {}, {})


def load_into(network: nn.Module, pretrained: FrozenEncoder) -> None:
    """Copy the weights and codebooks of a bundle into the features of a policy's network."""
    features = network.features_extractor
    assert isinstance(features, BottleneckFeatures)
    features.encoder.load_state_dict(pretrained.encoder.state_dict())
    features.bottleneck.load_state_dict(pretrained.bottleneck.state_dict())


def _is_picture(space: gymnasium.Space[Any]) -> bool:
    return isinstance(space, gymnasium.spaces.Box) and space.dtype == np.uint8 and len(space.shape) == 3


def _channels_first(space: gymnasium.Space[Any]) -> tuple[int, ...]:
    """Channels are the smallest side, the first one where two are as small."""
    shape = tuple(space.shape or ())
    return shape if shape[0] <= shape[2] else (shape[2], *shape[:2])
