"""An image beside the picture of a game: another one each episode (paper, offline Atari: CIFAR-10 on the side)."""

from __future__ import annotations

from typing import Literal

import numpy as np

from repdib_lightning.data.schema import FactorSpec
from repdib_lightning.environments.numbered_clips import NumberedClips
from repdib_lightning.errors import UserError, nearest

Side = Literal["none", "left", "right", "top", "bottom"]
SIDES = ("none", "left", "right", "top", "bottom")

WIDTHS = (3, 512)
"""Least and most pixels of the image; of fewer than three a ninth would be empty."""

_BUILT_IN = "procedural_images"
_COARSE = 3
_LUMA = np.array([0.299, 0.587, 0.114])  # ITU-R BT.601, as OpenCV and Pillow turn colours to grey


class SideImage:
    """A pool of grey stills, and how one of them stands beside square grey frames.

    The paper leaves side, width, scaling and colour open.

    Args:
        side: where the image is; ``none`` for no image.
        width: pixels that the picture grows by.
        source: see :mod:`repdib_lightning.environments.distractors`; of clips the first frame is shown. ``""`` for
            built-in stills.
        seed: decides the split of the images and what built-in ones look like.
        size: height and width of the frames in pixels.

    Attributes:
        shape: (H, W) of the frame with the image beside it.

    Raises:
        UserError: an unknown side, a width out of range, a source without a side, or unreadable images.
    """

    def __init__(self, side: Side, width: int, source: str, seed: int, size: int) -> None:
        if side not in SIDES:
            raise UserError(f"side={side}: unknown, {nearest(side, SIDES)}")
        if not WIDTHS[0] <= width <= WIDTHS[1]:
            raise UserError(f"side_width={width}: must be from {WIDTHS[0]} to {WIDTHS[1]}")
        if side == "none" and source:
            raise UserError(f"side_source={source}: means nothing with side=none; choose {', '.join(SIDES[1:])}")
        self.side, self._size, self._images = side, size, None
        if side != "none":
            shape = (size, width) if side in ("left", "right") else (width, size)
            self._images = _opened(source, seed, shape)
        self.shape = {
            "none": (size, size),
            "left": (size, size + width),
            "right": (size, size + width),
            "top": (size + width, size),
            "bottom": (size + width, size),
        }[side]
        self._shown: tuple[int, np.ndarray, np.ndarray] | None = None

    def draw(self, random: np.random.Generator, evaluation: bool, most: int | None = None) -> int:
        """Number of an image: of the training ones, or of the (first ``most``) held-out ones; 0 where there are
        none."""
        if self._images is None:
            return 0
        return int(random.choice(self._images.numbers(evaluation)[:most]))

    def image(self, number: int) -> np.ndarray:
        """The image alone: (H, width) uint8 at the left or right, (width, W) at the top or bottom.

        Raises:
            UserError: its file cannot be read.
        """
        return self._show(number)[1]

    def _show(self, number: int) -> tuple[int, np.ndarray, np.ndarray]:
        """Number, image, and (9,) mean greys; kept, since an image stays for an episode."""
        assert self._images is not None
        if self._shown is None or self._shown[0] != number:
            grey = np.round(self._images.clip(number)[0] @ _LUMA).astype(np.uint8)
            rows = np.array_split(grey, _COARSE, axis=0)
            means = [part.mean() for row in rows for part in np.array_split(row, _COARSE, axis=1)]
            self._shown = (number, grey, (np.array(means) / 255.0).astype(np.float32))
        return self._shown

    def beside(self, frames: np.ndarray, number: int) -> np.ndarray:
        """Put an image beside frames: (..., size, size) uint8 -> (..., H, W) uint8."""
        assert frames.shape[-2:] == (self._size, self._size)
        if self._images is None:
            return frames
        joined = np.empty((*frames.shape[:-2], *self.shape), np.uint8)
        image, size = self.image(number), self._size
        if self.side == "left":
            joined[..., :-size], joined[..., -size:] = image, frames
        elif self.side == "right":
            joined[..., :size], joined[..., size:] = frames, image
        elif self.side == "top":
            joined[..., :-size, :], joined[..., -size:, :] = image, frames
        else:
            joined[..., :size, :], joined[..., size:, :] = frames, image
        return joined

    def factors(self, number: int) -> dict[str, np.ndarray]:
        """The ground truth of what is beside the frame; see :meth:`factor_specs`. Empty without an image."""
        if self._images is None:
            return {}
        return {"clip": np.array(number), "background": self._show(number)[2].copy()}

    def factor_specs(self) -> dict[str, FactorSpec]:
        """``clip``: number of the image, training ones first. ``background``: (9,) mean grey, in [0, 1], of each ninth
        of it, row by row. Both exogenous."""
        if self._images is None:
            return {}
        return {
            "clip": FactorSpec("exogenous", "categorical", classes=len(self._images)),
            "background": FactorSpec("exogenous", "continuous", width=_COARSE**2),
        }


def _opened(source: str, seed: int, shape: tuple[int, int]) -> NumberedClips:
    try:
        return NumberedClips(source or _BUILT_IN, seed, size=shape)
    except UserError as error:
        raise UserError(f"side_source={source}: {str(error).removeprefix('distractors: ')}") from error
