"""What a greedy policy reaches: mazes from every start cell, other environments over a few episodes."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import gymnasium
import numpy as np

from repdib_lightning.environments.maze_batch import MazeBatch

Act = Callable[[dict[str, np.ndarray]], np.ndarray]
"""Observations name -> (n, *shape) to actions (n,)."""


class MazeEvaluation:
    """Every start cell but the goal's, each once, with the goal at the centre; the same backgrounds every time.

    Args:
        world, options: as of the environment that is trained in; its goals and starts are replaced.
        name: of the observation that the encoder takes.
        frame_stack: S.
    """

    def __init__(self, world: str, options: Mapping[str, Any], name: str, frame_stack: int) -> None:
        kept = {key: value for key, value in options.items() if key not in ("goals", "start", "render_mode")}
        size = MazeBatch(1, world, **kept).maze.cells
        self.mazes = MazeBatch(size, world, **{**kept, "evaluation": True})
        self._name, self._stack = name, frame_stack
        centre = self.mazes.maze.centre
        self._starts = np.arange(size) != centre
        self.shortest = float(self.mazes.maze.distances[centre][self._starts].mean())

    def run(self, act: Act) -> dict[str, float]:
        """Play an episode from every start cell at once.

        Returns:
            ``return``: mean undiscounted; ``success``: share of the starts from which the goal is reached; ``moves``:
            mean number of moves, the episode length where it is not.
        """
        mazes, centre = self.mazes, self.mazes.maze.centre
        mazes.reset(np.ones(len(mazes.cells), bool), np.random.default_rng(0))
        for cell in range(len(mazes.cells)):
            mazes.place(cell, cell, centre)
        running, returns, moves = self._starts.copy(), np.zeros(len(mazes.cells)), np.zeros(len(mazes.cells))
        reached = np.zeros(len(mazes.cells), bool)
        frames = [mazes.pictures()] * self._stack
        while running.any():
            actions = np.zeros(len(mazes.cells), np.int64)
            actions[running] = act({self._name: np.concatenate(frames, axis=1)[running]})
            moves += running
            rewards, arrived, truncated = mazes.move(actions, running)
            returns += rewards
            reached |= arrived
            running &= ~(arrived | truncated)
            frames = [*frames[1:], mazes.pictures()]
        starts = self._starts
        return {
            "return": float(returns[starts].mean()),
            "success": float(reached[starts].mean()),
            "moves": float(moves[starts].mean()),
        }


class EpisodeEvaluation:
    """Ten episodes of any environment.

    Args:
        environment: prepared for the encoder; used by nothing else.
        seed: of its first episode, the same every time.
    """

    episodes = 10

    def __init__(self, environment: gymnasium.Env[Any, Any], seed: int) -> None:
        self._environment, self._seed = environment, seed

    def run(self, act: Act) -> dict[str, float]:
        """Return ``return`` (mean undiscounted) and ``moves`` (mean steps of an episode)."""
        returns, moves = 0.0, 0
        for episode in range(self.episodes):
            observation, _ = self._environment.reset(seed=self._seed if episode == 0 else None)
            ended = False
            while not ended:
                action = act({name: array[None] for name, array in observation.items()})[0]
                observation, reward, terminated, truncated, _ = self._environment.step(action)
                returns, moves, ended = returns + float(reward), moves + 1, terminated or truncated
        return {"return": returns / self.episodes, "moves": moves / self.episodes}
