"""Topology of encoders whose latents are known."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
import torch

from repdib_lightning.environments.maze_batch import MazeBatch
from repdib_lightning.evaluation.topology import BACKGROUNDS, latent_topology

OPTIONS = {"size": 5, "cell_pixels": 4, "evaluation": True}


class Lookup:
    """Encodes pictures of a plain maze as rows of a table, one for each cell."""

    def __init__(self, mazes, table, frame_stack=1):
        maze = mazes.maze
        seen = mazes.painter.draw(np.arange(maze.cells), np.full(maze.cells, maze.centre))
        self._cells = {picture.tobytes(): cell for cell, picture in enumerate(seen)}
        self.spec, self._table = SimpleNamespace(frame_stack=frame_stack), np.asarray(table, np.float32)

    def encode(self, pictures):
        assert pictures.shape[1] == 3 * self.spec.frame_stack
        frames = pictures.reshape(len(pictures), self.spec.frame_stack, 3, *pictures.shape[2:])
        assert (frames == frames[:, :1]).all()  # standing still
        return torch.from_numpy(self._table[[self._cells[frame[0].tobytes()] for frame in frames]])


def mazes_of(world, **options):
    mazes = MazeBatch(25, world, **OPTIONS, **options)
    return mazes, mazes.maze


def topology(world, table, frame_stack=1):
    mazes, maze = mazes_of(world)
    return latent_topology(Lookup(mazes, table(maze), frame_stack), mazes), maze


def places(maze):
    return np.array([maze.place(cell) for cell in range(maze.cells)], float)


def unary(maze):
    """Squared distances of these are the moves in an open grid."""
    steps = np.arange(maze.size)
    return np.concatenate([steps[None] < column[:, None] for column in places(maze).T], axis=1)


def along_the_corridor(maze):
    return maze.distances[0][:, None]


@pytest.mark.parametrize("frame_stack", [1, 3])
def test_places_as_latents_follow_the_straight_line_exactly(frame_stack):
    found, _ = topology("SpiralWorld", places, frame_stack)
    measures = found.measures()
    assert (measures["straight_line"], measures["straight_line_pairs"]) == pytest.approx((1, 1))
    assert measures["topology"] < 0.9 and measures["topology_pairs"] < 0.9
    np.testing.assert_allclose(found.latent, found.straight, atol=1e-5)


@pytest.mark.parametrize(("world", "table"), [("GridWorld", unary), ("SpiralWorld", along_the_corridor)])
def test_embeddings_of_the_paths_follow_the_paths_exactly(world, table):
    measures = topology(world, table)[0].measures()
    assert (measures["topology"], measures["topology_pairs"]) == pytest.approx((1, 1))
    assert measures["straight_line"] < 1 and measures["straight_line_pairs"] < 1


def test_distances_from_the_centre_count_apart_from_those_of_all_pairs():
    measures = topology("LoopWorld", lambda maze: maze.distances[maze.centre][:, None])[0].measures()
    assert measures["topology"] == pytest.approx(1) and 0 < measures["topology_pairs"] < 0.99


def test_latents_turned_inside_out_follow_the_paths_backwards():
    def table(maze):
        away = 1.0 / (1 + maze.distances[maze.centre])
        away[maze.centre] = 0
        return away[:, None]

    assert topology("SpiralWorld", table)[0].measures()["topology"] == pytest.approx(-1)


def test_equal_latents_follow_nothing():
    found, _ = topology("GridWorld", lambda maze: np.full((maze.cells, 2), 0.3))
    assert found.measures() == dict.fromkeys(
        ("topology", "topology_pairs", "straight_line", "straight_line_pairs"), 0.0
    )


def test_maps_are_drawn_from_the_centre():
    found, maze = topology("LoopWorld", places)
    centre = places(maze)[maze.centre]
    np.testing.assert_allclose(found.latent_map, np.linalg.norm(places(maze) - centre, axis=1), atol=1e-6)
    np.testing.assert_array_equal(found.path_map, maze.distances[maze.centre])
    assert found.latent_map[maze.centre] == found.path_map[maze.centre] == 0 and found.centre == maze.centre


def test_cells_are_compared_before_the_same_background_and_averaged_over_several():
    mazes, maze = mazes_of("GridWorld", distractors="procedural")
    shown, scale = [], iter(range(1, BACKGROUNDS + 1))

    class Watching:
        spec = SimpleNamespace(frame_stack=1)

        def encode(self, pictures):
            shown.append(pictures.copy())
            return torch.from_numpy(places(maze) * next(scale))

    found = latent_topology(Watching(), mazes)
    goal = mazes.painter.draw(np.zeros(1, int), np.array([maze.centre]))[0]
    elsewhere = np.ones(goal.shape[1:], bool)
    elsewhere[8:12, 8:12] = False  # the goal's cell, which the agent once stands on
    for pictures in shown:
        for cell in range(1, maze.cells):
            both = elsewhere & ~mazes.painter.agent_masks(np.array([0, cell])).any(axis=0)
            np.testing.assert_array_equal(pictures[0][:, both], pictures[cell][:, both])
        assert (pictures[:, :, 9, 9] == goal[:, 9, 9]).sum() >= 3 * 24  # the goal, where the evaluation has it
    assert len({pictures.tobytes() for pictures in shown}) == len(shown) == BACKGROUNDS
    np.testing.assert_allclose(found.latent, found.straight * np.mean(range(1, BACKGROUNDS + 1)), atol=1e-9)
