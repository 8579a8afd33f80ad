"""Atari games amid an image on the side, as a gymnasium environment."""

from __future__ import annotations

from collections import deque
from typing import Any

import gymnasium
import numpy as np

from repdib_lightning.environments.atari_game import AtariGame
from repdib_lightning.environments.atari_ram import ram_factors
from repdib_lightning.environments.side_image import Side, SideImage
from repdib_lightning.errors import UserError

MAX_FRAMES = 108_000
"""Emulator frames of half an hour of play (Machado et al. 2018)."""


class AtariEnv(gymnasium.Env[np.ndarray, np.integer]):
    """A game of the Arcade Learning Environment from grey pixels, an image beside it (paper, offline Atari).

    Observations: (S, H, W) uint8, S frames stacked, the oldest first; W (or H) is larger by the image's width. Actions:
    A, the game's minimal set in ALE's order. Rewards are the game's, not clipped; an episode is a whole game, whatever
    lives are lost; nothing presses FIRE for the agent. ``info["factors"]`` holds the ground truth: the variables of
    :mod:`~repdib_lightning.environments.atari_ram`, and the image.

    A seed decides no-ops, sticky actions and the image, each by its own stream: whatever image is seen, the same seed
    and actions make the same game.

    Args:
        game: such as ``breakout`` or ``MsPacman``.
        image_size: height and width of the game's picture in pixels, 16 to 210.
        frame_skip: emulator frames (60 a second) an action is held for.
        frame_stack: S; the first frame is repeated when an episode begins.
        sticky: probability that the console repeats the action before, each emulator frame; 0.25 in Machado et al.
            (2018).
        noop_max: an episode begins after 1 to this many emulator frames without an action; 0 for none.
        max_frames: emulator frames, no-ops included, after which an episode is truncated.
        side: where the image is, ``none``, ``left``, ``right``, ``top`` or ``bottom``: another one each episode.
        side_width: pixels that the picture grows by, 3 to 512.
        side_source: a folder of pictures or of CIFAR-10, or empty for built-in images; see
            :mod:`repdib_lightning.environments.distractors`.
        distractor_seed: decides which images are held out, and what built-in ones look like.
        evaluation: show held-out images instead of the training ones.
        render_mode: ``rgb_array`` or None.

    Raises:
        UserError: an unknown game, an argument out of range, unreadable images, ale-py or OpenCV are missing.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 15}  # noqa: RUF012 (gymnasium's own convention)

    def __init__(
        self,
        game: str = "breakout",
        *,
        image_size: int = 84,
        frame_skip: int = 4,
        frame_stack: int = 1,
        sticky: float = 0.0,
        noop_max: int = 30,
        max_frames: int = MAX_FRAMES,
        side: Side = "none",
        side_width: int = 42,
        side_source: str = "",
        distractor_seed: int = 0,
        evaluation: bool = False,
        render_mode: str | None = None,
    ) -> None:
        if render_mode not in (None, "rgb_array"):
            raise UserError(f"render_mode={render_mode}: must be rgb_array or None")
        if frame_stack < 1:
            raise UserError(f"frame_stack={frame_stack}: must be at least 1")
        self.render_mode, self.evaluation = render_mode, evaluation
        self.game = AtariGame(
            game,
            image_size=image_size,
            frame_skip=frame_skip,
            sticky=sticky,
            noop_max=noop_max,
            max_frames=max_frames,
        )
        self.side_image = SideImage(side, side_width, side_source, distractor_seed, image_size)
        self.observation_space = gymnasium.spaces.Box(0, 255, (frame_stack, *self.side_image.shape), np.uint8)
        self.action_space = gymnasium.spaces.Discrete(self.game.actions)
        self._image = 0
        self._frames: deque[np.ndarray] = deque(maxlen=frame_stack)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Begin a game, with another image."""
        super().reset(seed=seed)
        noops, sticking, drawing = (np.random.default_rng(part) for part in self.np_random.integers(2**63, size=3))
        self.game.reset(noops, sticking)
        self._image = self.side_image.draw(drawing, self.evaluation)
        self._frames.extend([self._frame()] * (self._frames.maxlen or 1))
        return np.stack(self._frames), {"factors": self.factors()}

    def step(self, action: np.integer | int) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """Hold an action for the frame skip.

        Raises:
            UserError: the action does not exist.
        """
        reward = self.game.step(int(action))
        self._frames.append(self._frame())
        return np.stack(self._frames), reward, self.game.over, self.game.truncated, {"factors": self.factors()}

    def _frame(self) -> np.ndarray:
        return self.side_image.beside(self.game.picture(), self._image)

    def ram(self) -> np.ndarray:
        """(128,) uint8: all that the console remembers."""
        return self.game.ram()

    def factors(self) -> dict[str, np.ndarray]:
        """The ground truth of the moment: the game's variables, in the console's units, and what is beside it."""
        return {**ram_factors(self.game.name, self.game.ram()), **self.side_image.factors(self._image)}

    def render(self) -> np.ndarray | None:  # type: ignore[override]
        """(H, W, 3) uint8: the newest frame, grey; None without ``render_mode="rgb_array"``."""
        return None if self.render_mode is None else np.repeat(self._frames[-1][..., None], 3, axis=-1)
