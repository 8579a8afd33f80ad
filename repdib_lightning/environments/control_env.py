"""The Control Suite and URLB from pixels, amid distractors, as a gymnasium environment."""

from __future__ import annotations

from collections import deque
from typing import Any

import gymnasium
import numpy as np

from repdib_lightning.environments.control_background import Backgrounds, Playing
from repdib_lightning.environments.control_background import Kind as Distractors
from repdib_lightning.environments.control_scene import ControlCamera, Place, Quality, check_picture
from repdib_lightning.environments.control_task import ControlTask
from repdib_lightning.errors import UserError

_DEFAULT = "walker-walk"
_STARTS_TRIED = 8
"""Starts of episodes in which the sky is looked for."""


class ControlEnv(gymnasium.Env[np.ndarray, np.ndarray]):
    """A task of the DeepMind Control Suite or of URLB, filmed by its own camera (paper, offline visual control and
    exploration).

    Observations: (3 F, H, W) uint8, F frames stacked, the oldest first; W is half as much wider with a distractor at
    the side. Actions: (A,) float32 in [-1, 1]. Rewards are summed over the action repeat: a return is between 0 and
    1000. Episodes are truncated after 1000 control steps (``jaco``: 250 of both). ``info["factors"]`` holds the ground
    truth: what the task observes of its state, and what plays behind.

    Args:
        task: such as ``walker-walk``, the default.
        image_size: height of the picture in pixels (64 and 84 are usual), 16 to 512.
        action_repeat: control steps an action is held for.
        quality: ``fast`` or ``paper``; see :class:`~repdib_lightning.environments.control_scene.ControlCamera`.
        distractors: ``none``, ``image`` (another one each episode) or ``video`` (another one each episode, playing).
        place: ``sky``, ``sky_floor`` or ``side``.
        source: of the distractors: built in, a folder of pictures or videos, or of CIFAR-10; see
            :mod:`repdib_lightning.environments.distractors`. Empty for the built-in one.
        distractor_seed: decides which clips are held out, and what built-in ones look like.
        evaluation: show held-out clips instead of the training ones.
        frame_stack: F; the first frame is repeated when an episode begins.
        world: the task, where a gymnasium id such as ``repdib/WalkerRun-v0`` decides it.
        render_mode: ``rgb_array`` or None.

    Raises:
        UserError: an argument out of range, unreadable distractors or ones that would never be seen, MuJoCo 4, or no
            renderer.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 20}  # noqa: RUF012 (gymnasium's own convention)

    def __init__(
        self,
        task: str | None = None,
        *,
        image_size: int = 64,
        action_repeat: int = 2,
        quality: Quality = "fast",
        distractors: Distractors = "none",
        place: Place = "sky",
        source: str = "",
        distractor_seed: int = 0,
        evaluation: bool = False,
        frame_stack: int = 1,
        world: str | None = None,
        render_mode: str | None = None,
    ) -> None:
        if render_mode not in (None, "rgb_array"):
            raise UserError(f"render_mode={render_mode}: must be rgb_array or None")
        self.render_mode, self.evaluation = render_mode, evaluation
        check_picture(image_size, quality)
        if frame_stack < 1:
            raise UserError(f"frame_stack={frame_stack}: must be at least 1")
        if task is not None and world is not None:
            raise UserError(
                f"task={task}: the task is {world}; leave it out, or take repdib/Control-v0 for another one"
            )
        chosen = world if task is None else task
        self.task = ControlTask(_DEFAULT if chosen is None else chosen, action_repeat)
        self.backgrounds = Backgrounds(distractors, place, source, distractor_seed, image_size)
        self.camera = ControlCamera(self.task, image_size, quality, self.backgrounds.through)
        self._check_place()
        shape = (3 * frame_stack, image_size, image_size + self.backgrounds.panel)
        self.observation_space = gymnasium.spaces.Box(0, 255, shape, np.uint8)
        self.action_space = gymnasium.spaces.Box(-1.0, 1.0, (self.task.actions,), np.float32)
        self._playing, self._step = Playing(0, 0), 0
        self._frames: deque[np.ndarray] = deque(maxlen=frame_stack)

    def _check_place(self) -> None:
        """Refuse a sky that the camera, looking down, does not see."""
        if not self.backgrounds.through:
            return
        for seed in range(_STARTS_TRIED):
            self.task.reset(np.random.default_rng(seed))
            if self.camera.see(self.task).through.any():
                return
        self.close()
        raise UserError(f"place=sky: nothing of the sky is seen in {self.task.name}; choose sky_floor or side")

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Begin an episode, with another distractor."""
        super().reset(seed=seed)
        # Apart, so that what an episode shows does not decide how the next one starts.
        physics, drawing = (np.random.default_rng(part) for part in self.np_random.integers(2**63, size=2))
        self.task.reset(physics)
        self._playing, self._step = self.backgrounds.draw(drawing, self.evaluation), 0
        self._frames.clear()
        return self._stacked(), self._info()

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """Hold an action for the action repeat."""
        reward, terminated, truncated = self.task.step(action)
        self._step += 1
        return self._stacked(), reward, terminated, truncated, self._info()

    def _stacked(self) -> np.ndarray:
        """(3 F, H, W): the frame of the moment behind the ones before."""
        frame = self._observe()
        missing = (self._frames.maxlen or 1) - len(self._frames)
        self._frames.extend([frame] * max(1, missing))
        return frame if self._frames.maxlen == 1 else np.concatenate(self._frames)

    def _observe(self) -> np.ndarray:
        return self.backgrounds.shown(self.camera.see(self.task), self._playing, self._step)

    def _info(self) -> dict[str, Any]:
        return {"factors": {**self.task.factors(), **self.backgrounds.factors(self._playing, self._step)}}

    def render(self) -> np.ndarray | None:  # type: ignore[override]
        """(H, W, 3) uint8: the newest frame; None without ``render_mode="rgb_array"``."""
        return None if self.render_mode is None else self._observe().transpose(1, 2, 0)

    def close(self) -> None:
        """Free the graphics memory."""
        self.camera.close()
