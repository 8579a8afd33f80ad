"""Distractors of the Control Suite: an image or a video an episode, behind the agent or at its side."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from repdib_lightning.data.schema import FactorSpec
from repdib_lightning.environments.control_scene import PLACES, Seen
from repdib_lightning.environments.numbered_clips import NumberedClips
from repdib_lightning.errors import UserError, nearest

Kind = Literal["none", "image", "video"]
KINDS = ("none", "image", "video")

RECORDED_HELD_OUT = 4
"""Held-out clips that a recording's evaluation episodes show, so that each is seen in several of them."""

_SOURCES = {"image": "procedural_images", "video": "procedural"}
_COARSE = 3


@dataclass(frozen=True)
class Playing:
    """What is shown in one episode. Attributes: ``clip``, its number; ``first``, the frame shown at the start."""

    clip: int
    first: int


class Backgrounds:
    """The pool of clips, and how a clip and a picture become what the agent sees.

    Args:
        kind: ``image`` shows one picture throughout an episode, ``video`` plays from a drawn frame on, over again where
            it ends.
        place: ``sky``, ``sky_floor`` or ``side``: a panel of half the picture's width at its right.
        source: see :mod:`repdib_lightning.environments.distractors`; ``""`` for the built-in source of the kind.
        seed: decides the split of the clips and what built-in ones look like.
        size: height and width of the scene in pixels.

    Raises:
        UserError: unknown choices, or unreadable clips.
    """

    def __init__(self, kind: Kind, place: str, source: str, seed: int, size: int) -> None:
        if kind not in KINDS:
            raise UserError(f"distractors={kind}: unknown, {nearest(kind, KINDS)}")
        if place not in PLACES:
            raise UserError(f"place={place}: unknown, {nearest(place, PLACES)}")
        if kind == "none" and (source or place != PLACES[0]):
            said = f"source={source}" if source else f"place={place}"
            raise UserError(f"{said}: means nothing without distractors; choose distractors image or video")
        self.kind, self.place = kind, place
        self.panel = size // 2 if place == "side" and kind != "none" else 0
        self._clips = None
        if kind != "none":
            shape = (size, self.panel) if self.panel else (size, size)
            self._clips = NumberedClips(source or _SOURCES[kind], seed, size=shape)

    @property
    def through(self) -> str:
        """What a camera has to cut out."""
        return self.place if self._clips is not None and not self.panel else ""

    def draw(self, random: np.random.Generator, evaluation: bool, most: int | None = None) -> Playing:
        """Choose what an episode shows, of the training clips or of the held-out ones (the first ``most``)."""
        if self._clips is None:
            return Playing(0, 0)
        number = int(random.choice(self._clips.numbers(evaluation)[:most]))
        return Playing(number, int(random.integers(len(self._clips.clip(number)))))

    def frame(self, playing: Playing, step: int) -> np.ndarray:
        """(H, W, 3) uint8: what plays at a step of the episode."""
        assert self._clips is not None
        clip = self._clips.clip(playing.clip)
        return clip[(playing.first + (step if self.kind == "video" else 0)) % len(clip)]

    def shown(self, seen: Seen, playing: Playing, step: int) -> np.ndarray:
        """(3, H, W) uint8: the scene with its distractor."""
        if self._clips is None:
            return seen.picture.transpose(2, 0, 1)
        frame = self.frame(playing, step)
        picture = np.concatenate([seen.picture, frame], axis=1) if self.panel else seen.before(frame)
        return picture.transpose(2, 0, 1)

    def factors(self, playing: Playing, step: int) -> dict[str, np.ndarray]:
        """The ground truth of what plays; see :meth:`factor_specs`. Empty without distractors."""
        if self._clips is None:
            return {}
        return {"clip": np.array(playing.clip), "background": _coarse(self.frame(playing, step))}

    def factor_specs(self) -> dict[str, FactorSpec]:
        """``clip``: number of the clip, training clips first. ``background``: (27,) mean colour, in [0, 1], of each
        ninth of the frame that plays. Both exogenous."""
        if self._clips is None:
            return {}
        return {
            "clip": FactorSpec("exogenous", "categorical", classes=len(self._clips)),
            "background": FactorSpec("exogenous", "continuous", width=3 * _COARSE**2),
        }


def _coarse(frame: np.ndarray) -> np.ndarray:
    thirds = [np.array_split(rows, _COARSE, axis=1) for rows in np.array_split(frame, _COARSE, axis=0)]
    means = [part.mean((0, 1)) for row in thirds for part in row]
    return (np.concatenate(means) / 255.0).astype(np.float32)
