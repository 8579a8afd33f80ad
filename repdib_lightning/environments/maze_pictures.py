"""Draws mazes: small pictures for agents, and large ones that a person understands."""

from __future__ import annotations

import numpy as np
from PIL import Image, ImageDraw

from repdib_lightning.environments.mazes import STEPS, Maze

AGENT, GOAL, WALL, FLOOR = (230, 60, 50), (60, 200, 90), (50, 90, 230), (0, 0, 0)
"""Colours (red, green, blue) of what agents see."""

_PAPER = (252, 252, 250)
_CELL = 56
_EDGE = 10


class MazePainter:
    """What agents see: (3, H, W) uint8 with H = W = size * cell_pixels.

    The goal fills its cell; the agent is a square one pixel smaller on each side, so that both show where they meet.

    Args:
        maze: the maze.
        cell_pixels: height and width of a cell, at least 3.
        show_walls: draw the inner walls, one pixel wide on each side. Without them the three worlds look the same: they
            share their observations and differ in what moves do, as in the paper.
    """

    def __init__(self, maze: Maze, cell_pixels: int = 5, show_walls: bool = False) -> None:
        self.maze, self.cell_pixels = maze, cell_pixels
        self.pixels = maze.size * cell_pixels
        self._agents, self._goals = self._squares(1), self._squares(0)
        self._walls = np.flatnonzero(self._wall_pixels()) if show_walls else np.empty(0, np.int64)

    def draw(self, agents: np.ndarray, goals: np.ndarray, backgrounds: np.ndarray | None = None) -> np.ndarray:
        """Draw n pictures.

        Args:
            agents: (n,) cells.
            goals: (n,) cells; -1 for none.
            backgrounds: (n, H, W, 3) uint8, seen where nothing is drawn; the black floor by default.

        Returns:
            (n, 3, H, W) uint8.
        """
        count = len(agents)
        if backgrounds is None:
            pictures = np.empty((count, 3, self.pixels**2), np.uint8)
            pictures[:] = np.array(FLOOR, np.uint8)[:, None]
        else:
            pictures = backgrounds.reshape(count, -1, 3).transpose(0, 2, 1).copy()
        pictures[:, :, self._walls] = np.array(WALL, np.uint8)[:, None]
        seen = np.flatnonzero(goals >= 0)
        _fill(pictures, seen, self._goals[goals[seen]], GOAL)
        _fill(pictures, np.arange(count), self._agents[agents], AGENT)
        return pictures.reshape(count, 3, self.pixels, self.pixels)

    def agent_masks(self, agents: np.ndarray) -> np.ndarray:
        """(n,) cells -> (n, H, W) bool: where the agent is drawn."""
        masks = np.zeros((len(agents), self.pixels**2), bool)
        masks[np.arange(len(agents))[:, None], self._agents[agents]] = True
        return masks.reshape(-1, self.pixels, self.pixels)

    def _squares(self, inset: int) -> np.ndarray:
        """(cells, p) int64: for each cell the pixels, numbered row by row, of a square in its middle."""
        side = np.arange(inset, self.cell_pixels - inset)
        rows, columns = np.divmod(np.arange(self.maze.cells), self.maze.size)
        down = rows[:, None] * self.cell_pixels + side
        right = columns[:, None] * self.cell_pixels + side
        return (down[:, :, None] * self.pixels + right[:, None, :]).reshape(self.maze.cells, -1)

    def _wall_pixels(self) -> np.ndarray:
        mask = np.zeros((self.pixels, self.pixels), bool)
        last = self.cell_pixels - 1
        for cell in range(self.maze.cells):
            row, column = (part * self.cell_pixels for part in self.maze.place(cell))
            for action, (down, right) in enumerate(STEPS):
                if self.maze.neighbours[cell, action] != cell or not self._inner(cell, (down, right)):
                    continue
                if down:
                    mask[row + (last if down > 0 else 0), column : column + last + 1] = True
                else:
                    mask[row : row + last + 1, column + (last if right > 0 else 0)] = True
        return mask

    def _inner(self, cell: int, step: tuple[int, int]) -> bool:
        row, column = self.maze.place(cell)
        return self.maze.has((row + step[0], column + step[1]))


def _fill(pictures: np.ndarray, which: np.ndarray, pixels: np.ndarray, colour: tuple[int, int, int]) -> None:
    """Colour the pixels (k, p) of the pictures ``which`` (k,) of (n, 3, H * W)."""
    channels = np.arange(3)[:, None]
    pictures[which[:, None, None], channels, pixels[:, None, :]] = np.array(colour, np.uint8)[:, None]


def draw_for_people(
    maze: Maze, agent: int | None, goal: int | None, background: np.ndarray | None = None
) -> Image.Image:
    """Draw cells, blue walls, the goal as a green square and the agent as a red disc, 356 pixels wide for size 6.

    Args:
        maze: the maze.
        agent, goal: cells; None for none.
        background: (H, W, 3) uint8, scaled to the floor; white by default.
    """
    side = maze.size * _CELL
    picture = Image.new("RGB", (side + 2 * _EDGE, side + 2 * _EDGE), _PAPER)
    if background is not None:
        picture.paste(Image.fromarray(background).resize((side, side), Image.Resampling.NEAREST), (_EDGE, _EDGE))
    pen = ImageDraw.Draw(picture)
    for line in range(maze.size + 1):
        at = _EDGE + line * _CELL
        pen.line([(at, _EDGE), (at, _EDGE + side)], fill=(225, 225, 228))
        pen.line([(_EDGE, at), (_EDGE + side, at)], fill=(225, 225, 228))
    if goal is not None:
        pen.rectangle(_box(maze, goal, 5), fill=GOAL)
    if agent is not None:
        pen.ellipse(_box(maze, agent, 11), fill=AGENT, outline=(120, 20, 15), width=2)
    for start, end in wall_lines(maze):
        ends = [(_EDGE + column * _CELL, _EDGE + row * _CELL) for row, column in (start, end)]
        pen.line(ends, fill=WALL, width=6)
    return picture


def wall_lines(maze: Maze) -> list[tuple[tuple[int, int], tuple[int, int]]]:
    """Walls as lines between corners of cells, (row, column) each, the outer ones included; each once."""
    lines = set()
    for cell in range(maze.cells):
        row, column = maze.place(cell)
        corners = {
            0: ((row, column), (row, column + 1)),
            1: ((row + 1, column), (row + 1, column + 1)),
            2: ((row, column), (row + 1, column)),
            3: ((row, column + 1), (row + 1, column + 1)),
        }
        lines |= {corners[action] for action in corners if maze.neighbours[cell, action] == cell}
    return sorted(lines)


def _box(maze: Maze, cell: int, inset: int) -> tuple[int, int, int, int]:
    row, column = (_EDGE + part * _CELL for part in maze.place(cell))
    return column + inset, row + inset, column + _CELL - inset, row + _CELL - inset
