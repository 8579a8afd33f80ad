"""The three worlds, walked cell by cell, against shortest paths of an independent program."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.sparse import csr_array
from scipy.sparse.csgraph import shortest_path

from repdib_lightning.environments.mazes import MOVES, STEPS, WORLDS, build_maze
from repdib_lightning.errors import UserError

SIZES = (4, 5, 6, 9)


def reference_distances(maze) -> np.ndarray:
    """(cells, cells): by scipy, from the list of passages alone."""
    ends = np.array(sorted(maze.passages)).T
    graph = csr_array((np.ones(ends.shape[1]), (ends[0], ends[1])), shape=(maze.cells, maze.cells))
    return shortest_path(graph, directed=False, unweighted=True)


def others(maze, cell: int) -> set[int]:
    return set(maze.neighbours[cell].tolist()) - {cell}


@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("world", WORLDS)
def test_every_move_stays_or_leads_to_the_next_cell_and_back(world, size):
    maze = build_maze(world, size)
    assert maze.neighbours.shape == (size**2, len(MOVES))
    for cell in range(maze.cells):
        for action, (down, right) in enumerate(STEPS):
            reached = int(maze.neighbours[cell, action])
            row, column = maze.place(cell)
            assert reached == cell or maze.place(reached) == (row + down, column + right)
            opposite = STEPS.index((-down, -right))
            assert reached == cell or maze.neighbours[reached, opposite] == cell
            if (0 <= row + down < size) and (0 <= column + right < size):
                beside = maze.number((row + down, column + right))
                assert (reached == beside) == ((min(cell, beside), max(cell, beside)) in maze.passages)
            else:
                assert reached == cell


@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("world", WORLDS)
def test_distances_are_those_of_scipy(world, size):
    maze = build_maze(world, size)
    assert np.array_equal(maze.distances, reference_distances(maze))


def test_gridworld_has_no_inner_walls():
    maze = build_maze("GridWorld")
    rows, columns = np.divmod(np.arange(36), 6)
    straight = np.abs(rows[:, None] - rows) + np.abs(columns[:, None] - columns)
    assert np.array_equal(maze.distances, straight)
    assert (maze.neighbours == np.arange(36)[:, None]).sum() == 4 * 6, "only the outer walls stop a move"


def test_the_spiral_is_one_path_from_the_corner_to_the_centre():
    maze = build_maze("SpiralWorld")
    degrees = [len(others(maze, cell)) for cell in range(36)]
    assert sorted(degrees) == [1, 1] + [2] * 34
    assert {cell for cell in range(36) if degrees[cell] == 1} == {0, maze.centre}
    assert maze.distances[0, maze.centre] == 35
    path, before = [0], -1
    while (ahead := others(maze, path[-1]) - {before}) != set():
        before = path[-1]
        path.append(ahead.pop())
    assert sorted(path) == list(range(36)) and path[-1] == maze.centre == maze.number((3, 2))
    places = [maze.place(cell) for cell in path]
    assert places[:6] == [(0, column) for column in range(6)]
    assert places[15:22] == [(5, 0), (4, 0), (3, 0), (2, 0), (1, 0), (1, 1), (1, 2)], "round the corner, and inwards"


def test_the_loop_is_the_spiral_with_an_opening_at_the_bottom_right():
    spiral, loop = build_maze("SpiralWorld"), build_maze("LoopWorld")
    opened = {tuple(loop.place(cell) for cell in pair) for pair in loop.passages - spiral.passages}
    assert spiral.passages < loop.passages
    assert opened == {((4, 4), (4, 5)), ((4, 4), (5, 4))}
    far, short = spiral.number((0, 5)), spiral.number((4, 4))
    assert (spiral.distances[far, short], loop.distances[far, short]) == (21, 5)


def test_all_worlds_share_their_centre():
    for size in SIZES:
        centres = {build_maze(world, size).centre for world in WORLDS}
        assert len(centres) == 1
        row, column = build_maze("GridWorld", size).place(centres.pop())
        assert abs(row - (size - 1) / 2) <= 0.5 and abs(column - (size - 1) / 2) <= 0.5


def test_the_tables_cannot_be_changed():
    maze = build_maze("GridWorld")
    for table in (maze.neighbours, maze.distances):
        with pytest.raises(ValueError, match="read-only"):
            table[0, 0] = 1


@pytest.mark.parametrize(
    ("arguments", "said"),
    [(("SpiralWrld",), "did you mean 'SpiralWorld'"), (("GridWorld", 3), "size=3"), (("GridWorld", 33), "size=33")],
)
def test_bad_arguments_are_named(arguments, said):
    with pytest.raises(UserError, match=said):
        build_maze(*arguments)
