"""Counts how often a training agent was in each cell of a maze."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np

from repdib_lightning.environments.maze_env import MazeEnv


class CountVisits(gymnasium.Wrapper[Any, Any, Any, Any]):
    """Counts the cells of a maze, the first of each episode included.

    Attributes:
        visits: (cells,) int64.
    """

    def __init__(self, env: gymnasium.Env[Any, Any], maze: MazeEnv) -> None:
        super().__init__(env)
        self._maze = maze
        self.visits = np.zeros(maze.maze.cells, np.int64)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Begin an episode."""
        begun = super().reset(seed=seed, options=options)
        self._count()
        return begun

    def step(self, action: Any) -> Any:
        """Move."""
        moved = super().step(action)
        self._count()
        return moved

    def _count(self) -> None:
        self.visits[self._maze.batch.cells[0]] += 1
