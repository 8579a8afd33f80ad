"""Clips of both splits under one numbering, so that the number of a clip is a factor of the picture."""

from __future__ import annotations

import numpy as np

from repdib_lightning.environments.distractors import Distractors


class NumberedClips:
    """The clips of a source, numbered over both splits: training clips first.

    Args:
        source: see :mod:`repdib_lightning.environments.distractors`.
        seed: decides the split and what procedural clips look like.
        size: height and width in pixels, or one number for both.
        limits: clips to use at most of the training and of the evaluation split; None for all.

    Raises:
        UserError: unknown source, missing or empty folder, too few clips for two splits.
    """

    def __init__(
        self,
        source: str,
        seed: int,
        *,
        size: int | tuple[int, int],
        limits: tuple[int | None, int | None] = (None, None),
    ) -> None:
        train = Distractors.from_spec(source, "train", seed=seed, size=size, limit=limits[0])
        held_out = Distractors.from_spec(source, "evaluation", seed=seed, size=size, limit=limits[1])
        self._pools = (train, held_out)

    def __len__(self) -> int:
        return len(self._pools[0]) + len(self._pools[1])

    def numbers(self, evaluation: bool) -> np.ndarray:
        """Clip numbers of the training or of the evaluation pool."""
        train = len(self._pools[0])
        return np.arange(train, len(self)) if evaluation else np.arange(train)

    def clip(self, number: int) -> np.ndarray:
        """(T, H, W, 3) uint8."""
        train = len(self._pools[0])
        return self._pools[0].clip(number) if number < train else self._pools[1].clip(number - train)
