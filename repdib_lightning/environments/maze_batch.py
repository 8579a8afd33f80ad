"""The mazes' rules for many mazes at a time: starts, moves, rewards and pictures as array operations."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np

from repdib_lightning.environments.distractors import Distractors
from repdib_lightning.environments.maze_pictures import MazePainter
from repdib_lightning.environments.mazes import Maze, build_maze
from repdib_lightning.errors import UserError

NO_GOAL = -1
CellName = str | Sequence[int]
"""A cell as users name it: ``centre``, ``"row,column"`` or (row, column)."""


class MazeBatch:
    """n mazes that are stepped together; the environments around it only add an interface.

    The arguments are those of :class:`~repdib_lightning.environments.maze_env.MazeEnv`.

    Attributes:
        maze: the world. painter: draws it. goal_cells: (g,) cells that an episode's goal is drawn from.
        cells, goals, steps: (n,) int64, the state of each maze; goals are -1 without a goal.
    """

    def __init__(
        self,
        count: int,
        world: str,
        *,
        size: int = 6,
        cell_pixels: int = 5,
        goals: str | Iterable[CellName] | None = None,
        start: CellName = "random",
        evaluation: bool = False,
        episode_length: int = 100,
        show_walls: bool = False,
        distractors: str | None = None,
        distractor_seed: int = 0,
    ) -> None:
        for name, value, least in (("cell_pixels", cell_pixels, 3), ("episode_length", episode_length, 1)):
            if value < least:
                raise UserError(f"{name}={value}: must be at least {least}")
        self.maze = build_maze(world, size)
        self.goal_cells = np.array(_goals(self.maze, goals, evaluation), np.int64)
        self.start = None if start == "random" else cell_of(self.maze, start, "start")
        if self.start is not None and self.start in self.goal_cells:
            raise UserError(f"start={start}: is also a goal, so that an episode would end before it begins")
        self.episode_length = episode_length
        self.painter = MazePainter(self.maze, cell_pixels, show_walls)
        self._clips: Distractors | None = None
        if distractors is not None:
            split = "evaluation" if evaluation else "train"
            pixels = self.painter.pixels
            self._clips = Distractors.from_spec(distractors, split, seed=distractor_seed, size=pixels)
        self.cells, self.goals, self.steps, self._clip, self._frame = np.zeros((5, count), np.int64)

    def reset(self, which: np.ndarray, random: np.random.Generator) -> None:
        """Begin episodes: draw goal, start (never on the goal) and background of the mazes in the mask (n,)."""
        for index in np.flatnonzero(which):
            goal = int(random.choice(self.goal_cells)) if len(self.goal_cells) else NO_GOAL
            start = int(random.integers(self.maze.cells - (goal != NO_GOAL)))
            start += int(goal != NO_GOAL and start >= goal)
            self.place(index, start if self.start is None else self.start, goal)
            if self._clips is not None:
                self._clip[index] = random.integers(len(self._clips))
                self._frame[index] = random.integers(len(self._clips.clip(int(self._clip[index]))))

    def place(self, index: int, cell: int, goal: int) -> None:
        """Begin an episode of one maze at a chosen cell with a chosen goal (-1: none)."""
        self.cells[index], self.goals[index], self.steps[index] = cell, goal, 0

    def move(self, actions: np.ndarray, which: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Move the mazes in the mask (all by default).

        Returns:
            rewards (n,) float64, reached (n,) bool, truncated (n,) bool; 0 and False outside the mask.
        """
        moving = np.ones(len(self.cells), bool) if which is None else which
        self.cells = np.where(moving, self.maze.neighbours[self.cells, actions], self.cells)
        self.steps += moving
        if self._clips is not None:
            self._frame += moving
        reached = moving & (self.cells == self.goals)
        rewards = -1.0 * (moving & ~reached)
        return rewards, reached, moving & (self.steps >= self.episode_length)

    def pictures(self) -> np.ndarray:
        """(n, 3, H, W) uint8."""
        return self.painter.draw(self.cells, self.goals, self.backgrounds())

    def backgrounds(self) -> np.ndarray | None:
        """(n, H, W, 3) uint8, or None where the floor is plain."""
        if self._clips is None:
            return None
        clips = [self._clips.clip(int(clip)) for clip in self._clip]
        return np.stack([clip[frame % len(clip)] for clip, frame in zip(clips, self._frame, strict=True)])

    def factors(self) -> dict[str, np.ndarray]:
        """Ground truth of the pictures: name -> (n,) int64."""
        found = {"position": self.cells.copy()}
        if len(self.goal_cells):
            found["goal"] = self.goals.copy()
        if self._clips is not None:
            found["clip"] = self._clip.copy()
        return found

    @property
    def clip_count(self) -> int:
        """How many backgrounds there are; 0 for a plain floor."""
        return 0 if self._clips is None else len(self._clips)


def training_goals(maze: Maze) -> list[int]:
    """The centre and the three corners that are not the spiral's mouth: the small finite set of the paper."""
    last = maze.size - 1
    return [maze.centre, *(maze.number(corner) for corner in ((0, last), (last, last), (last, 0)))]


def cell_of(maze: Maze, name: Any, option: str) -> int:
    """The number of a cell that a user named.

    Raises:
        UserError: naming the option and the nearest cell: not a cell, or one outside the maze or between two cells.
    """
    if name == "centre":
        return maze.centre
    try:
        row, column = (float(part) for part in (name.split(",") if isinstance(name, str) else name))
    except (TypeError, ValueError) as error:
        raise UserError(f"{option}={name!r:.40}: expected row,column such as 3,2, or centre") from error
    near = tuple(int(min(max(round(part), 0), maze.size - 1)) if part == part else 0 for part in (row, column))
    if near != (row, column):
        where = "outside" if not maze.has((row, column)) else "in a wall between the cells"
        raise UserError(
            f"{option}={row:g},{column:g}: lies {where} of {maze.name}, whose cells go from 0,0 to {maze.size - 1},"
            f"{maze.size - 1}; the nearest is {near[0]},{near[1]}"
        )
    return maze.number((near[0], near[1]))


def _goals(maze: Maze, given: Any, evaluation: bool) -> list[int]:
    if given is None:
        return [maze.centre] if evaluation else training_goals(maze)
    named = given.split() if isinstance(given, str) else list(given)
    if named == ["none"]:
        return []
    if not named:
        raise UserError("goals: names no cell; expected cells such as '3,2 0,5', or none for a maze without a goal")
    return list(dict.fromkeys(cell_of(maze, cell, "goals") for cell in named))
