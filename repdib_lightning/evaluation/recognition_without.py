"""Which modalities a clip has, and the same clip with some of them taken away."""

from __future__ import annotations

from collections.abc import Collection, Sequence

import torch
from torch import Tensor

from repdib_lightning.records import DataSpec


def modalities_of(spec: DataSpec) -> list[str]:
    """Names of the observations that may be missing of a clip: its videos and its sequences of readings."""
    return [name for name, array in spec.observations.items() if array.is_video or array.is_sequence]


def others(names: Sequence[str], name: str) -> tuple[str, ...]:
    """What is missing where only this modality is there."""
    return tuple(other for other in names if other != name)


def ways_to_miss(names: Sequence[str]) -> list[tuple[str, ...]]:
    """Nothing, then each of the modalities, then all but one; nothing alone where there are fewer than two.

    Of two modalities, one missing is the other alone, and stands here once.
    """
    if len(names) < 2:
        return [()]
    return list(dict.fromkeys([(), *((name,) for name in names), *(others(names, name) for name in names)]))


def taken_away(observations: dict[str, Tensor], names: Collection[str]) -> dict[str, Tensor]:
    """Name -> (N, *shape) with some of them as a store holds what is missing: frames of zeros, readings of NaN."""
    return {name: _nothing(array) if name in names else array for name, array in observations.items()}


def _nothing(array: Tensor) -> Tensor:
    return torch.full_like(array, torch.nan) if array.is_floating_point() else torch.zeros_like(array)
