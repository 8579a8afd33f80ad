"""A Control Suite task from its state, as a gymnasium environment: what behaviour policies are trained in."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np

from repdib_lightning.environments.control_task import ControlTask


class ControlStateEnv(gymnasium.Env[np.ndarray, np.ndarray]):
    """Observations: the task's state in one vector, (X,) float32. Actions: (A,) float32 in [-1, 1].

    Args:
        task: such as ``walker-walk``.
        action_repeat: see :class:`ControlTask`.

    Raises:
        UserError: as :class:`ControlTask`.
    """

    metadata = {"render_modes": []}  # noqa: RUF012 (gymnasium's own convention)

    def __init__(self, task: str, action_repeat: int = 2) -> None:
        self.task = ControlTask(task, action_repeat)
        self.observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (sum(self.task.sizes.values()),), np.float32)
        self.action_space = gymnasium.spaces.Box(-1.0, 1.0, (self.task.actions,), np.float32)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Begin an episode."""
        super().reset(seed=seed)
        self.task.reset(self.np_random)
        return self.task.state(), {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """Hold an action for the action repeat."""
        reward, terminated, truncated = self.task.step(action)
        return self.task.state(), reward, terminated, truncated, {}
