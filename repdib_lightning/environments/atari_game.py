"""One game of the Arcade Learning Environment, played by steps: no-ops, frame skip, pooled grey pictures, its RAM.

As in gymnasium's ``AtariPreprocessing`` (Machado et al. 2018; Mnih et al. 2015), but that a picture is drawn only when
it is asked for, that the last picture of a game is that of its last frame, and that no-ops and sticky actions are
decided by seeds of their own.
"""

from __future__ import annotations

import numpy as np

from repdib_lightning.environments.atari_games import game_name, loaded
from repdib_lightning.errors import UserError

SIZES = (16, 210)
"""Least and most pixels of a picture's side; the screen has 160 x 210."""


class AtariGame:
    """A cartridge in a console.

    Args:
        game: such as ``breakout``.
        image_size: height and width of the pictures in pixels.
        frame_skip: emulator frames an action is held for.
        sticky: probability that the console repeats the action before, each emulator frame.
        noop_max: an episode begins after 1 to this many frames without an action; 0 for none.
        max_frames: emulator frames, no-ops included, after which an episode is truncated.

    Attributes:
        actions: A, of the minimal action set.
        over: whether the game is over. truncated: whether it was cut off before.

    Raises:
        UserError: an unknown game, an argument out of range, ale-py or OpenCV are missing.
    """

    def __init__(
        self, game: str, *, image_size: int, frame_skip: int, sticky: float, noop_max: int, max_frames: int
    ) -> None:
        if not SIZES[0] <= image_size <= SIZES[1]:
            raise UserError(f"image_size={image_size}: must be from {SIZES[0]} to {SIZES[1]}")
        if not 0.0 <= sticky < 1.0:
            raise UserError(f"sticky={sticky}: must be at least 0 and below 1")
        for option, value, least in (("frame_skip", frame_skip, 1), ("noop_max", noop_max, 0)):
            if value < least:
                raise UserError(f"{option}={value}: must be at least {least}")
        if max_frames < noop_max + frame_skip:
            raise UserError(
                f"max_frames={max_frames}: must be at least {noop_max + frame_skip}, the no-ops and an action"
            )
        self.name, self.image_size, self.frame_skip = game_name(game), image_size, frame_skip
        self._noop_max = noop_max
        self._settings = {"repeat_action_probability": float(sticky), "max_num_frames_per_episode": max_frames}
        self._console = loaded(self.name, **self._settings)
        self._switched_on = self._console.cloneState()
        self._codes = self._console.getMinimalActionSet()
        self.actions = len(self._codes)
        self._sticky = sticky
        height, width = self._console.getScreenDims()
        self._screens = np.zeros((2, height, width), np.uint8)
        self._pooled = False
        self.over = self.truncated = True

    def reset(self, noops: np.random.Generator, sticking: np.random.Generator) -> None:
        """Begin an episode; the generators decide the no-ops, and the sticky actions of all of the episode."""
        if self._sticky:  # the console takes a seed only with a cartridge, and nothing else in it depends on chance
            seed = int(sticking.integers(2**31 - 1))
            self._console = loaded(self.name, random_seed=seed, **self._settings)
        else:  # the reset button does not clear all of a console: Seaquest goes another way after another game
            self._console.restoreState(self._switched_on)
        count = int(noops.integers(1, self._noop_max + 1)) if self._noop_max else 0
        self._console.reset_game()
        for _ in range(count):
            self._console.act(self._codes[0])
            if self._console.game_over():
                self._console.reset_game()
        self._pooled, self.over, self.truncated = False, False, False

    def step(self, action: int) -> float:
        """Hold an action for the frame skip, or until the game is over; returns the summed reward.

        Raises:
            UserError: the action does not exist.
        """
        assert not (self.over or self.truncated), "the episode has ended, call reset()"
        if not 0 <= action < self.actions:
            raise UserError(f"action={action}: {self.name} has actions 0 to {self.actions - 1}")
        reward, self._pooled = 0, False
        for frame in range(self.frame_skip):
            if self.frame_skip > 1 and frame == self.frame_skip - 1:
                self._console.getScreenGrayscale(self._screens[1])
                self._pooled = True
            reward += self._console.act(self._codes[action])
            if self._console.game_over():
                self.over = self._console.game_over(with_truncation=False)
                self.truncated = not self.over
                break
        return float(reward)

    def picture(self) -> np.ndarray:
        """(image_size, image_size) uint8 grey: the brighter of the last two frames at each pixel, scaled.

        Two, because sprites flicker; one where an episode begins.
        """
        import cv2

        self._console.getScreenGrayscale(self._screens[0])
        screen = self._screens.max(0) if self._pooled else self._screens[0]
        size = (self.image_size, self.image_size)
        return np.asarray(cv2.resize(screen, size, interpolation=cv2.INTER_AREA), dtype=np.uint8)

    def lives(self) -> int:
        """How many are left, the one that is played included; 0 in games without."""
        return int(self._console.lives())

    def ram(self) -> np.ndarray:
        """(128,) uint8: all that the console remembers."""
        return np.array(self._console.getRAM(), dtype=np.uint8)
