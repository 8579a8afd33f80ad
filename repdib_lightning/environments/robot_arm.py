"""The robot arm's rules: grid and actions, and the noise around the arm (paper, robot experiment).

The arm stands over one cell of a 3x3 grid (the true state). Everything else in the picture is noise: a TV that plays
video, lamps that change colour, a flash, and daylight that drifts over the whole recording, so that the time step
shows in the picture.
"""

from __future__ import annotations

import colorsys
from dataclasses import dataclass

import numpy as np

from repdib_lightning.data.schema import FactorSpec
from repdib_lightning.environments.numbered_clips import NumberedClips
from repdib_lightning.environments.robot_arm_scene import CELLS, LAMPS, TV_SIZE, Moment

ACTIONS = ("forward", "back", "left", "right", "stay")
"""Meaning of the discrete actions 0..4; forward is away from the base. A move into a wall stays where it is."""

MOVES = np.array([[1, 0], [-1, 0], [0, -1], [0, 1], [0, 0]])
HOME = 4
"""Every episode starts in the middle cell (recalibration)."""

TRAINING_CLIPS, EVALUATION_CLIPS = 12, 4
JOINT_NOISE = 0.02
CLIP_STEPS = (25, 60)
LAMP_CHANGE = 1 / 15
FLASH_ON, FLASH_STAYS = 0.15, 0.5
DRIFT_WAVE, DRIFT_WAVES, FLICKER = 0.08, 3, 0.01
"""Standard deviation of the joint noise (radians); steps that a clip plays; chance a step that a lamp changes colour;
chances that the flash turns on and that it stays on; size and number of the daylight's slow waves; its flicker."""


def factor_specs(videos: int) -> dict[str, FactorSpec]:
    """The ground-truth factors of a recording whose TV knows ``videos`` clips (training, then evaluation).

    - ``cell``: 0..8, row-major, row 0 nearest to the base, column 0 left. The only endogenous one.
    - ``time_step``: row within the whole recording, divided by the number of rows: [0, 1).
    - ``video``: which clip the TV plays; numbers of training clips come first.
    - ``video_frame``: position within that clip, [0, 1).
    - ``lamp_colours``: (9,) rgb of the three lamps, each in [0, 1].
    - ``flash``: 0 off, 1 on.
    - ``ambient``: strength of the daylight, [0, 1].
    """
    return {
        "cell": FactorSpec("endogenous", "categorical", classes=CELLS),
        "time_step": FactorSpec("exogenous", "continuous"),
        "video": FactorSpec("exogenous", "categorical", classes=videos),
        "video_frame": FactorSpec("exogenous", "continuous"),
        "lamp_colours": FactorSpec("exogenous", "continuous", width=3 * LAMPS),
        "flash": FactorSpec("exogenous", "categorical", classes=2),
        "ambient": FactorSpec("exogenous", "continuous"),
    }


def move(cell: int, action: int) -> int:
    """The cell that an action leads to."""
    row, column = np.clip(np.array(divmod(cell, 3)) + MOVES[action], 0, 2)
    return int(3 * row + column)


class Television(NumberedClips):
    """The clips that the TV can play, (T, 64, 64, 3) uint8 each."""

    def __init__(self, source: str, seed: int) -> None:
        super().__init__(source, seed, size=TV_SIZE, limits=(TRAINING_CLIPS, EVALUATION_CLIPS))


@dataclass(frozen=True)
class Noise:
    """Everything exogenous in an episode of T rows, planned ahead: it never depends on what the arm does.

    Attributes:
        time_step, ambient, warmth: (T,) in [0, 1]; see :class:`Moment` and :func:`factor_specs`.
        video, frame: (T,) clip number and frame number.
        lamps: (T, 3, 3) rgb in [0, 1].
        flash: (T,) bool.
        joints: (T, 6) radians.
    """

    time_step: np.ndarray
    ambient: np.ndarray
    warmth: np.ndarray
    video: np.ndarray
    frame: np.ndarray
    lamps: np.ndarray
    flash: np.ndarray
    joints: np.ndarray

    def moment(self, t: int, cell: int, television: Television) -> Moment:
        """What the scene looks like at row t with the arm in a cell."""
        picture = television.clip(int(self.video[t]))[int(self.frame[t])]
        return Moment(
            cell,
            self.joints[t],
            picture,
            self.lamps[t],
            bool(self.flash[t]),
            float(self.ambient[t]),
            float(self.warmth[t]),
        )

    def factors(self, television: Television) -> dict[str, np.ndarray]:
        """Name -> (T, ...) of every exogenous factor."""
        shown, where = np.unique(self.video, return_inverse=True)
        lengths = np.array([len(television.clip(int(number))) for number in shown])[where]
        return {
            "time_step": self.time_step.astype(np.float32),
            "video": self.video.astype(np.int64),
            "video_frame": (self.frame / lengths).astype(np.float32),
            "lamp_colours": self.lamps.reshape(len(self.lamps), -1).astype(np.float32),
            "flash": self.flash.astype(np.int64),
            "ambient": self.ambient.astype(np.float32),
        }


def plan_noise(rng: np.random.Generator, progress: np.ndarray, television: Television, evaluation: bool) -> Noise:
    """Draw the noise of an episode.

    Args:
        rng: the episode's own generator.
        progress: (T,) position of each row within the whole recording, [0, 1).
        television: what can be played.
        evaluation: whether the TV plays the evaluation clips.
    """
    rows = len(progress)
    wave = DRIFT_WAVE * np.sin(2 * np.pi * DRIFT_WAVES * progress) + FLICKER * rng.standard_normal(rows)
    video, frame = _plan_television(rng, rows, television, evaluation)
    return Noise(
        time_step=progress,
        ambient=np.clip(0.1 + 0.8 * progress + wave, 0.0, 1.0),
        warmth=progress,
        video=video,
        frame=frame,
        lamps=np.stack([_plan_lamp(rng, rows) for _ in range(LAMPS)], axis=1),
        flash=_plan_flash(rng, rows),
        joints=JOINT_NOISE * rng.standard_normal((rows, 6)),
    )


def _plan_television(
    rng: np.random.Generator, rows: int, television: Television, evaluation: bool
) -> tuple[np.ndarray, np.ndarray]:
    pool = television.numbers(evaluation)
    videos, frames = np.empty(rows, dtype=np.int64), np.empty(rows, dtype=np.int64)
    begin, playing = 0, -1
    while begin < rows:
        others = pool[pool != playing] if len(pool) > 1 else pool
        playing = int(rng.choice(others))
        length = len(television.clip(playing))
        end = min(rows, begin + int(rng.integers(*CLIP_STEPS, endpoint=True)))
        videos[begin:end] = playing
        frames[begin:end] = (rng.integers(length) + np.arange(end - begin)) % length
        begin = end
    return videos, frames


def _plan_lamp(rng: np.random.Generator, rows: int) -> np.ndarray:
    """(T, 3) rgb: a saturated colour that is replaced at random moments."""
    changes = rng.random(rows) < LAMP_CHANGE
    hues, saturations = rng.random(rows), rng.uniform(0.6, 1.0, rows)
    colours = np.array([colorsys.hsv_to_rgb(h, s, 1.0) for h, s in zip(hues, saturations, strict=True)])
    changes[0] = True
    return colours[np.maximum.accumulate(np.where(changes, np.arange(rows), 0))]


def _plan_flash(rng: np.random.Generator, rows: int) -> np.ndarray:
    draws, on, states = rng.random(rows), False, np.empty(rows, dtype=bool)
    for t in range(rows):
        on = bool(draws[t] < (FLASH_STAYS if on else FLASH_ON))
        states[t] = on
    return states
