"""The mazes as a gymnasium environment."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import gymnasium
import numpy as np

from repdib_lightning.environments.maze_batch import NO_GOAL, CellName, MazeBatch
from repdib_lightning.environments.maze_pictures import draw_for_people
from repdib_lightning.environments.mazes import MOVES
from repdib_lightning.errors import UserError


class MazeEnv(gymnasium.Env[np.ndarray, np.integer]):
    """Find the goal in a maze of 6x6 cells, from pixels (paper, section and appendix on maze navigation).

    Observation: (3, H, W) uint8: the agent as a red square, the goal as a green one. Actions: 0 up, 1 down, 2 left,
    3 right; a move into a wall stays. Reward: -1.0 a step, 0.0 on the step that reaches the goal and ends the episode.
    Without a goal every step costs -1.0, which tells nothing of where to go. ``info["factors"]``: ``position`` and
    ``goal`` as cell numbers (row * size + column), ``clip``: number of the background, training ones first.

    The paper leaves goal encoding, picture size, episode length, starts and the set of training goals open.

    Args:
        world: ``GridWorld``, ``SpiralWorld`` or ``LoopWorld``.
        size: cells along each side.
        cell_pixels: pixels along each side of a cell.
        goals: cells that an episode's goal is drawn from, such as ``"centre 0,5"`` or ``[(3, 2)]``; ``none`` for no
            goal. By default the four cells in the middle, one of them the centre; in evaluation the centre alone.
        start: where episodes begin: ``random`` (any cell but the goal), or a cell.
        evaluation: the goal is the centre, and backgrounds are those kept for evaluation.
        episode_length: steps until truncation; 1.4 for each cell by default, 50 of 36 cells.
        show_walls: draw the walls into the observation.
        distractors: what plays behind the maze, one still or clip an episode, from a random moment on; see
            :mod:`repdib_lightning.environments.distractors`. None: a black floor.
        distractor_seed: decides the clips.
        render_mode: ``rgb_array`` or None.

    Raises:
        UserError: an unknown world, a cell outside of it, an argument out of range, unreadable distractors.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 4}  # noqa: RUF012 (gymnasium's own convention)

    def __init__(
        self,
        world: str = "GridWorld",
        *,
        size: int = 6,
        cell_pixels: int = 5,
        goals: str | Iterable[CellName] | None = None,
        start: CellName = "random",
        evaluation: bool = False,
        episode_length: int | None = None,
        show_walls: bool = False,
        distractors: str | None = None,
        distractor_seed: int = 0,
        render_mode: str | None = None,
    ) -> None:
        if render_mode not in (None, "rgb_array"):
            raise UserError(f"render_mode={render_mode}: must be rgb_array or None")
        self.render_mode = render_mode
        self.batch = MazeBatch(
            1,
            world,
            size=size,
            cell_pixels=cell_pixels,
            goals=goals,
            start=start,
            evaluation=evaluation,
            episode_length=episode_length,
            show_walls=show_walls,
            distractors=distractors,
            distractor_seed=distractor_seed,
        )
        self.maze = self.batch.maze
        pixels = self.batch.painter.pixels
        self.observation_space = gymnasium.spaces.Box(0, 255, (3, pixels, pixels), np.uint8)
        self.action_space = gymnasium.spaces.Discrete(len(MOVES))
        self._running = False

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Start an episode; ``options={"start": cell, "goal": cell}`` choose, each as the arguments name cells.

        Raises:
            UserError: another option, a cell outside the maze, or a start on the goal.
        """
        super().reset(seed=seed)
        self.batch.reset(np.ones(1, bool), self.np_random, **self.batch.chosen(options))
        self._running = True
        return self.batch.pictures()[0], self._info()

    def step(self, action: np.integer) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """Move.

        Raises:
            UserError: the action does not exist.
        """
        assert self._running, "the episode has ended, call reset()"
        rewards, reached, truncated = self.batch.move(np.array([action]))
        self._running = not (reached[0] or truncated[0])
        return self.batch.pictures()[0], float(rewards[0]), bool(reached[0]), bool(truncated[0]), self._info()

    def render(self) -> np.ndarray | None:  # type: ignore[override]
        """(H, W, 3) uint8: walls, goal and agent, for people; None without ``render_mode="rgb_array"``."""
        if self.render_mode is None:
            return None
        goal = int(self.batch.goals[0])
        backgrounds = self.batch.backgrounds()
        background = None if backgrounds is None else backgrounds[0]
        return np.asarray(
            draw_for_people(self.maze, int(self.batch.cells[0]), None if goal == NO_GOAL else goal, background)
        )

    def _info(self) -> dict[str, Any]:
        return {"factors": {name: int(values[0]) for name, values in self.batch.factors().items()}}
