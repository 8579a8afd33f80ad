"""A deterministic world whose pictures tell where they come from; imports little, for worker processes."""

from __future__ import annotations

import os
import signal
from typing import Any

import gymnasium
import numpy as np

STEPS = 5
ACTIONS = 2
PICTURE = (3, 3, 4)
"""Four bytes of the seed, the step, and what was done."""


class Telling(gymnasium.Env[np.ndarray, np.ndarray]):
    """An episode of STEPS actions; pictures hold the seed, the step and the sum of all actions.

    Args:
        ends: how an episode ends: ``cut``, as it should; ``late``; ``early``; ``terminated``; by an ``error``;
            ``killed``.
    """

    observation_space = gymnasium.spaces.Box(0, 255, PICTURE, np.uint8)
    action_space = gymnasium.spaces.Box(-1.0, 1.0, (ACTIONS,), np.float32)

    def __init__(self, ends: str = "cut") -> None:
        self.ends = ends

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[np.ndarray, dict[str, Any]]:
        super().reset(seed=seed)
        assert seed is not None
        self.seed, self.done, self.sum = seed, 0, np.zeros(ACTIONS)
        return self._picture(), self._info()

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        self.done, self.sum = self.done + 1, self.sum + action
        if self.ends == "error" and self.done == 2:
            raise ZeroDivisionError("the floor is gone")
        if self.ends == "killed" and self.done == 2:
            os.kill(os.getpid(), signal.SIGKILL)
        last = self.done == {"early": STEPS - 2, "late": STEPS + 1}.get(self.ends, STEPS)
        terminated = last and self.ends == "terminated"
        return self._picture(), float(action[0]) + self.seed % 7, terminated, last and not terminated, self._info()

    def _picture(self) -> np.ndarray:
        picture = np.zeros(PICTURE, np.uint8)
        picture[0, 0] = np.frombuffer(np.uint32(self.seed).tobytes(), np.uint8)
        picture[1] = self.done
        picture[2, 0, :ACTIONS] = np.round(100 * self.sum).astype(np.int64) % 256
        return picture

    def _info(self) -> dict[str, Any]:
        return {"factors": {"sum": self.sum.astype(np.float32), "clock": np.array([self.done], np.float32)}}


class Opener:
    """Opens a world; pickles by name, for worker processes."""

    def __init__(self, ends: str = "cut") -> None:
        self.ends = ends

    def __call__(self) -> Telling:
        return Telling(self.ends)
