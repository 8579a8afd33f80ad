"""The mazes of the paper: which cells touch, and how many moves lie between them."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise

import numpy as np

from repdib_lightning.errors import UserError, nearest

MOVES = ("up", "down", "left", "right")
"""The actions, in order."""

STEPS = ((-1, 0), (1, 0), (0, -1), (0, 1))
"""Change of (row, column) of each action."""

WORLDS = ("GridWorld", "SpiralWorld", "LoopWorld")
SMALLEST, LARGEST = 4, 32

Cell = tuple[int, int]
"""(row, column), from the top left."""


@dataclass(frozen=True)
class Maze:
    """A square of cells with thin walls between some of them (paper, appendix on maze navigation).

    Attributes:
        name: of :data:`WORLDS`.
        size: cells along each side.
        passages: pairs of neighbouring cells, as numbers ``row * size + column``, that no wall parts; each pair once,
            the smaller number first.
    """

    name: str
    size: int
    passages: frozenset[tuple[int, int]]

    @property
    def cells(self) -> int:
        """How many cells there are."""
        return self.size**2

    @cached_property
    def centre(self) -> int:
        """The cell where the spiral ends: one of the middle ones, and the goal of every evaluation."""
        return self.number(list(_spiral(self.size))[-1])

    @cached_property
    def neighbours(self) -> np.ndarray:
        """(cells, 4) int64: the cell that each move leads to; the same cell where a wall is."""
        table = np.tile(np.arange(self.cells)[:, None], len(STEPS))
        for cell in range(self.cells):
            for action, step in enumerate(STEPS):
                row, column = self.place(cell)[0] + step[0], self.place(cell)[1] + step[1]
                if self.has((row, column)) and self.is_open(cell, self.number((row, column))):
                    table[cell, action] = self.number((row, column))
        table.setflags(write=False)
        return table

    @cached_property
    def distances(self) -> np.ndarray:
        """(cells, cells) int64: moves on the shortest path; every cell can be reached."""
        found = np.full((self.cells, self.cells), -1)
        for start in range(self.cells):
            edge, moves = [start], 0
            while edge:
                found[start, edge] = moves
                edge = [int(cell) for cell in np.unique(self.neighbours[edge]) if found[start, cell] < 0]
                moves += 1
        assert (found >= 0).all(), f"{self.name} has cells that cannot be reached"
        found.setflags(write=False)
        return found

    def is_open(self, cell: int, other: int) -> bool:
        """Whether one move leads from a cell to another."""
        return (min(cell, other), max(cell, other)) in self.passages

    def has(self, cell: tuple[float, float]) -> bool:
        """Whether (row, column) is inside."""
        return all(0 <= part < self.size for part in cell)

    def number(self, cell: Cell) -> int:
        """``row * size + column``."""
        return cell[0] * self.size + cell[1]

    def place(self, number: int) -> Cell:
        """Inverse of :meth:`number`."""
        return divmod(int(number), self.size)


def build_maze(name: str, size: int = 6) -> Maze:
    """Build one of the three worlds.

    - ``GridWorld``: no walls inside.
    - ``SpiralWorld``: one corridor that winds from the top left corner to the centre.
    - ``LoopWorld``: the same with an opening at the bottom right, where the wall between the two outer turns has its
      corner: the outer part becomes a loop.

    Args:
        name: of the world.
        size: cells along each side (paper: 6).

    Raises:
        UserError: an unknown world, or a size out of range.
    """
    if name not in WORLDS:
        raise UserError(f"unknown maze '{name}', {nearest(name, WORLDS)}")
    if not SMALLEST <= size <= LARGEST:
        raise UserError(f"size={size}: a maze has {SMALLEST} to {LARGEST} cells along each side")
    touching = {(cell, cell + step) for cell in range(size**2) for step in _to_right_and_below(cell, size)}
    if name == "GridWorld":
        return Maze(name, size, frozenset(touching))
    path = [row * size + column for row, column in _spiral(size)]
    passages = {(min(pair), max(pair)) for pair in pairwise(path)}
    if name == "LoopWorld":
        corner = (size - 2) * size + size - 2
        passages |= {(corner, corner + 1), (corner, corner + size)}
    return Maze(name, size, frozenset(passages))


def _to_right_and_below(cell: int, size: int) -> Iterator[int]:
    if cell % size < size - 1:
        yield 1
    if cell < size * (size - 1):
        yield size


def _spiral(size: int) -> Iterator[Cell]:
    """Cells from the top left corner clockwise inwards."""
    for ring in range((size + 1) // 2):
        low, high = ring, size - 1 - ring
        yield from ((low, column) for column in range(low, high + 1))
        yield from ((row, high) for row in range(low + 1, high + 1))
        if high > low:
            yield from ((high, column) for column in range(high - 1, low - 1, -1))
            yield from ((row, low) for row in range(high - 1, low, -1))
