"""The robot arm as a gymnasium environment, for online agents and for policies of your own."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np

from repdib_lightning.environments.robot_arm import ACTIONS, HOME, Noise, Television, move, plan_noise
from repdib_lightning.environments.robot_arm_scene import CAMERAS, CELLS, RobotArmScene
from repdib_lightning.errors import UserError


class RobotArmEnv(gymnasium.Env[dict[str, np.ndarray], np.integer]):
    """A Jaco arm over a 3x3 grid, amid TV, lamps, flash and drifting daylight.

    Observations: ``front`` and ``top``, each (3, H, W) uint8. Actions: 0 forward (away from the base), 1 back, 2 left,
    3 right, 4 stay; a move into a wall stays. The reward is always 0.0, unless a ``goal`` is given: then -1.0 a step,
    and 0.0 with termination on the step that reaches the goal, as in the mazes. ``info["factors"]`` holds the ground
    truth of the picture (see :func:`repdib_lightning.environments.robot_arm.factor_specs`).

    The daylight drifts on over episodes: a seeded reset starts a new recording, an unseeded one goes on with it. After
    ``recording`` steps the daylight drifts back.

    Args:
        image_size: height and width in pixels.
        episode_length: steps until truncation.
        distractors: what the TV plays; see :mod:`repdib_lightning.environments.distractors`.
        distractor_seed: decides the TV's clips.
        evaluation: the TV plays the evaluation clips instead of the training ones.
        goal: cell 0..8 to reach, or None.
        random_start: start in a random cell instead of the middle one.
        recording: steps over which the daylight drifts from dusk to noon.
        render_mode: ``rgb_array`` or None.

    Raises:
        UserError: an argument out of range, unreadable distractors, no renderer.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 4}  # noqa: RUF012 (gymnasium's own convention)

    def __init__(
        self,
        *,
        image_size: int = 64,
        episode_length: int = 500,
        distractors: str = "procedural",
        distractor_seed: int = 0,
        evaluation: bool = False,
        goal: int | None = None,
        random_start: bool = False,
        recording: int = 14_000,
        render_mode: str | None = None,
    ) -> None:
        if goal is not None and not 0 <= goal < CELLS:
            raise UserError(f"goal={goal}: must be a cell from 0 to {CELLS - 1}")
        if render_mode not in (None, "rgb_array"):
            raise UserError(f"render_mode={render_mode}: must be rgb_array or None")
        for name, value in (("image_size", image_size), ("episode_length", episode_length), ("recording", recording)):
            if value < 1:
                raise UserError(f"{name}={value}: must be at least 1")
        self.render_mode = render_mode
        self.goal, self.evaluation, self.random_start = goal, evaluation, random_start
        self.episode_length, self.recording = episode_length, recording
        picture = gymnasium.spaces.Box(0, 255, (3, image_size, image_size), np.uint8)
        self.observation_space: Any = gymnasium.spaces.Dict(dict.fromkeys(CAMERAS, picture))
        self.action_space = gymnasium.spaces.Discrete(len(ACTIONS))
        self._television = Television(distractors, distractor_seed)
        self._scene = RobotArmScene(image_size)
        self._clock = 0
        self._cell, self._step = HOME, 0
        self._noise: Noise | None = None
        self._factors: dict[str, np.ndarray] = {}

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
        """Start an episode; ``options={"cell": c}`` chooses the starting cell.

        Raises:
            UserError: the starting cell does not exist.
        """
        super().reset(seed=seed)
        self._clock = 0 if seed is not None else self._clock + self._step
        start = int(self.np_random.integers(CELLS)) if self.random_start else HOME
        self._cell = int((options or {}).get("cell", start))
        if not 0 <= self._cell < CELLS:
            raise UserError(f"cell={self._cell}: must be from 0 to {CELLS - 1}")
        self._step = 0
        elapsed = (self._clock + np.arange(self.episode_length + 1)) / self.recording % 2.0
        progress = np.where(elapsed < 1.0, elapsed, 2.0 - elapsed)
        self._noise = plan_noise(self.np_random, progress, self._television, self.evaluation)
        self._factors = self._noise.factors(self._television)
        return self._observe(), self._info()

    def step(self, action: np.integer) -> tuple[dict[str, np.ndarray], float, bool, bool, dict[str, Any]]:
        """Move (or not), and let the world around go on."""
        assert self._noise is not None, "call reset() first"
        assert self._step < self.episode_length, "the episode has ended, call reset()"
        self._cell = move(self._cell, int(action))
        self._step += 1
        reached = self._cell == self.goal
        reward = 0.0 if self.goal is None or reached else -1.0
        return self._observe(), reward, reached, self._step == self.episode_length, self._info()

    def _observe(self) -> dict[str, np.ndarray]:
        assert self._noise is not None
        return self._scene.pictures(self._noise.moment(self._step, self._cell, self._television))

    def _info(self) -> dict[str, Any]:
        exogenous = {name: values[self._step] for name, values in self._factors.items()}
        return {"factors": {"cell": self._cell, **exogenous}}

    def render(self) -> np.ndarray | None:  # type: ignore[override]
        """(H, 2 W, 3) uint8, both views side by side; None without ``render_mode="rgb_array"``."""
        if self.render_mode is None:
            return None
        views = self._observe()
        return np.concatenate([views[name].transpose(1, 2, 0) for name in CAMERAS], axis=1)

    def close(self) -> None:
        """Free the graphics memory."""
        self._scene.close()
