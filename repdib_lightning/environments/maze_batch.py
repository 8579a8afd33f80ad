"""The mazes' rules for many mazes at a time: starts, moves, rewards and pictures as array operations."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from numbers import Real
from typing import Any

import numpy as np

from repdib_lightning.environments.maze_pictures import MazePainter
from repdib_lightning.environments.mazes import MOVES, Maze, build_maze
from repdib_lightning.environments.numbered_clips import NumberedClips
from repdib_lightning.errors import UserError, nearest

NO_GOAL = -1
SMALLEST_CELL, LARGEST_CELL = 3, 64
STEPS_A_CELL = 1.4
"""Of an episode, by default: enough for the longest corridor, 35 moves of 36 cells, and some errors."""

CellName = str | Sequence[int]
"""A cell as users name it: ``centre``, ``"row,column"`` or (row, column)."""


class MazeBatch:
    """n mazes that are stepped together; the environments around it only add an interface.

    The arguments are those of :class:`~repdib_lightning.environments.maze_env.MazeEnv`.

    Attributes:
        maze: the world. painter: draws it. goal_cells: (g,) cells that an episode's goal is drawn from.
        start: the cell where episodes begin, or None: any.
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
        episode_length: int | None = None,
        show_walls: bool = False,
        distractors: str | None = None,
        distractor_seed: int = 0,
    ) -> None:
        for name, value in (("num_envs", count), ("episode_length", episode_length)):
            if value is not None and value < 1:
                raise UserError(f"{name}={value}: must be at least 1")
        if distractor_seed < 0:
            raise UserError(f"distractor_seed={distractor_seed}: must not be negative")
        if not SMALLEST_CELL <= cell_pixels <= LARGEST_CELL:
            raise UserError(f"cell_pixels={cell_pixels}: must be from {SMALLEST_CELL} to {LARGEST_CELL}")
        self.maze = build_maze(world, size)
        self.goal_cells = np.array(_goals(self.maze, goals, evaluation), np.int64)
        self.start = None if isinstance(start, str) and start == "random" else cell_of(self.maze, start, "start")
        if self.start is not None and self.start in self.goal_cells:
            raise UserError(f"start={start}: is also a goal, so that an episode would end before it begins")
        self.episode_length = episode_length or round(STEPS_A_CELL * self.maze.cells)
        self.painter = MazePainter(self.maze, cell_pixels, show_walls)
        self._clips: NumberedClips | None = None
        if distractors is not None:
            self._clips = NumberedClips(distractors, distractor_seed, size=self.painter.pixels)
            self._clip_numbers = self._clips.numbers(evaluation)
        self.cells, self.goals, self.steps, self._clip, self._frame = np.zeros((5, count), np.int64)

    def reset(
        self,
        which: np.ndarray,
        random: np.random.Generator,
        starts: np.ndarray | None = None,
        goals: np.ndarray | None = None,
    ) -> None:
        """Begin episodes of the mazes in the mask: draw goal, start (never on the goal) and background.

        Args:
            which: (n,) bool.
            random: what draws.
            starts, goals: (n,) cells instead of drawn ones; see :meth:`chosen`.

        Raises:
            UserError: a start lies on its goal.
        """
        index = np.flatnonzero(which)
        start = None if self.start is None else np.full(len(index), self.start)
        start = start if starts is None else starts[index]
        goal = self._drawn_goals(start, len(index), random) if goals is None else goals[index]
        start = self._drawn_starts(goal, random) if start is None else start
        for cell in start[start == goal][:1]:
            raise UserError(f"start={self._named(cell)}: is also the goal; an episode would end before it begins")
        self.cells[index], self.goals[index], self.steps[index] = start, goal, 0
        if self._clips is not None:
            clips = random.choice(self._clip_numbers, len(index))
            self._clip[index] = clips
            self._frame[index] = random.integers([len(self._clips.clip(int(clip))) for clip in clips])

    def _drawn_goals(self, starts: np.ndarray | None, count: int, random: np.random.Generator) -> np.ndarray:
        """(k,) goals, apart from the starts (k,) where these are fixed already."""
        if not len(self.goal_cells):
            return np.full(count, NO_GOAL)
        goals = random.choice(self.goal_cells, count)
        while starts is not None and len(self.goal_cells) > 1 and (goals == starts).any():
            goals = np.where(goals == starts, random.choice(self.goal_cells, count), goals)
        return goals

    def _drawn_starts(self, goals: np.ndarray, random: np.random.Generator) -> np.ndarray:
        has_goal = goals != NO_GOAL
        starts = random.integers(self.maze.cells - has_goal)
        return starts + (has_goal & (starts >= goals))

    def _named(self, cell: int) -> str:
        return "{},{}".format(*self.maze.place(cell))

    def chosen(self, options: Mapping[str, Any] | None) -> dict[str, np.ndarray]:
        """What ``reset(options=...)`` of the environments means, as arguments of :meth:`reset`.

        Args:
            options: ``start`` and ``goal``, each one cell as users name them, or a sequence of n cells.

        Raises:
            UserError: another option, a cell outside the maze, or neither 1 nor n cells.
        """
        known = {"start": "starts", "goal": "goals"}
        found = {}
        for name, value in (options or {}).items():
            if name not in known:
                raise UserError(f"reset: unknown option '{name}', {nearest(name, known)}")
            cells = [value] if _is_one_cell(value) else list(value)
            if len(cells) not in (1, len(self.cells)):
                raise UserError(f"{name}: names {len(cells)} cells for {len(self.cells)} mazes; give one, or one each")
            numbers = np.array([cell_of(self.maze, cell, name) for cell in cells], np.int64)
            found[known[name]] = np.broadcast_to(numbers, len(self.cells))
        return found

    def place(self, index: int, cell: int, goal: int) -> None:
        """Begin an episode of one maze at a chosen cell with a chosen goal (-1: none)."""
        self.cells[index], self.goals[index], self.steps[index] = cell, goal, 0

    def share_background(self) -> None:
        """Give all mazes the background of the first one, at the same moment."""
        self._clip[:], self._frame[:] = self._clip[0], self._frame[0]

    def move(self, actions: np.ndarray, which: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Move the mazes in the mask (all by default).

        Args:
            actions: (n,) integers in [0, 4); those outside the mask do nothing.
            which: (n,) bool.

        Returns:
            rewards (n,) float64, reached (n,) bool, truncated (n,) bool; 0 and False outside the mask.

        Raises:
            UserError: actions of another shape, type or range.
        """
        actions = self._valid(actions)
        moving = np.ones(len(self.cells), bool) if which is None else which
        self.cells = np.where(moving, self.maze.neighbours[self.cells, actions], self.cells)
        self.steps += moving
        if self._clips is not None:
            self._frame += moving
        reached = moving & (self.cells == self.goals)
        rewards = -1.0 * (moving & ~reached)
        return rewards, reached, moving & (self.steps >= self.episode_length)

    def _valid(self, actions: np.ndarray) -> np.ndarray:
        given = np.asarray(actions)
        if given.shape != self.cells.shape or given.dtype.kind not in "iu":
            expected = f"integers of shape ({len(self.cells)},)"
            raise UserError(f"actions: expected {expected}, got {given.dtype} of shape {given.shape}")
        for wrong in given[(given < 0) | (given >= len(MOVES))][:1]:
            raise UserError(f"action {wrong}: must be from 0 to {len(MOVES) - 1} ({', '.join(MOVES)})")
        return given

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
        """Ground truth of the pictures: name -> (n,) int64; ``clip`` numbers the training clips before the others."""
        found = {"position": self.cells.copy()}
        if len(self.goal_cells) or (self.goals != NO_GOAL).any():
            found["goal"] = self.goals.copy()
        if self._clips is not None:
            found["clip"] = self._clip.copy()
        return found

    @property
    def clip_count(self) -> int:
        """How many backgrounds there are in both splits; 0 for a plain floor."""
        return 0 if self._clips is None else len(self._clips)


def training_goals(maze: Maze) -> list[int]:
    """The centre and the three cells that make a square with it: a small finite set, as in the paper."""
    middle = maze.size // 2
    square = [maze.number((row, column)) for row in (middle - 1, middle) for column in (middle - 1, middle)]
    return list(dict.fromkeys([maze.centre, *square]))


def cell_of(maze: Maze, name: Any, option: str) -> int:
    """The number of a cell that a user named.

    Raises:
        UserError: naming the option and the nearest cell: not a cell, or one outside the maze or between two cells.
    """
    if isinstance(name, str) and name == "centre":
        return maze.centre
    try:
        row, column = (float(part) for part in (name.split(",") if isinstance(name, str) else name))
    except (TypeError, ValueError) as error:
        raise UserError(f"{option}={name!s:.40}: expected row,column such as 3,2, or centre") from error
    near = tuple(round(min(max(part, 0.0), maze.size - 1.0)) if part == part else 0 for part in (row, column))
    if near != (row, column):
        where = "in a wall between the cells" if maze.has((row, column)) else "outside"
        raise UserError(
            f"{option}={row:g},{column:g}: lies {where} of {maze.name}, whose cells go from 0,0 to {maze.size - 1},"
            f"{maze.size - 1}; the nearest is {near[0]},{near[1]}"
        )
    return maze.number((near[0], near[1]))


def _goals(maze: Maze, given: Any, evaluation: bool) -> list[int]:
    if given is None:
        return [maze.centre] if evaluation else training_goals(maze)
    if not isinstance(given, Iterable):
        raise UserError(f"goals={given}: expected cells such as '3,2 0,5', or none for a maze without a goal")
    named = given.split() if isinstance(given, str) else list(given)
    if len(named) == 1 and isinstance(named[0], str) and named[0] == "none":
        return []
    if not named:
        raise UserError("goals: names no cell; expected cells such as '3,2 0,5', or none for a maze without a goal")
    return list(dict.fromkeys(cell_of(maze, cell, "goals") for cell in named))


def _is_one_cell(value: Any) -> bool:
    """Whether this is a name or (row, column), not a sequence of these."""
    if isinstance(value, str) or not isinstance(value, Iterable):
        return True
    parts = list(value)
    return bool(parts) and all(isinstance(part, Real) for part in parts)
