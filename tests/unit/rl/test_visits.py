"""Visits of a maze: the first cell of each episode and every one after a move, walls included."""

from __future__ import annotations

import numpy as np

from repdib_lightning.environments.maze_env import MazeEnv
from repdib_lightning.rl.visits import CountVisits


def test_resets_and_moves_are_counted():
    maze = MazeEnv("GridWorld", size=4, cell_pixels=3, goals="none", episode_length=5)
    counted = CountVisits(maze, maze)
    assert counted.visits.tolist() == [0] * 16
    counted.reset(options={"start": "0,0"})
    for action in (0, 1, 1, 3, 2):  # up stays; down, down, right, left
        counted.step(action)
    counted.reset(options={"start": "3,3"})
    wanted = np.zeros(16, int)
    wanted[[0, 4, 8, 9, 15]] = [2, 1, 2, 1, 1]
    assert counted.visits.tolist() == wanted.tolist()


def test_the_goal_is_counted_and_any_walk_adds_up():
    maze = MazeEnv("LoopWorld", size=4, cell_pixels=3, episode_length=9)
    counted = CountVisits(maze, maze)
    wanted, random, ended = np.zeros(16, int), np.random.default_rng(0), True
    for step in range(300):
        if ended:
            _, info = counted.reset(seed=step)
            ended = False
        else:
            _, _, reached, truncated, info = counted.step(random.integers(4))
            ended = reached or truncated
            assert not reached or info["factors"]["position"] == info["factors"]["goal"]
        wanted[info["factors"]["position"]] += 1
    assert counted.visits.tolist() == wanted.tolist() and counted.visits.sum() == 300
