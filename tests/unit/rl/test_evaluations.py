"""Evaluations against explicit loops over single environments."""

from __future__ import annotations

import zlib
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.spaces import Box, Dict, Discrete

from repdib_lightning.environments.maze_batch import MazeBatch
from repdib_lightning.environments.maze_env import MazeEnv
from repdib_lightning.environments.mazes import WORLDS
from repdib_lightning.export.gymnasium_wrapper import PrepareObservation
from repdib_lightning.records import ArraySpec, DataSpec
from repdib_lightning.rl.evaluation import EpisodeEvaluation, MazeEvaluation

SMALL = {"size": 4, "cell_pixels": 4, "episode_length": 14}


def shortest_path(evaluation):
    """A policy that reads the agent's cell from the picture."""
    maze, painter = evaluation.mazes.maze, evaluation.mazes.painter
    seen = painter.draw(np.arange(maze.cells), np.full(maze.cells, maze.centre))
    cell_of = {picture.tobytes(): cell for cell, picture in enumerate(seen)}

    def act(observations):
        cells = [cell_of[picture[-3:].tobytes()] for picture in observations["view"]]
        return maze.distances[maze.centre][maze.neighbours[cells]].argmin(axis=1)

    return act


def scrambled(observations):
    """A policy that hangs on every pixel of every frame."""
    return np.array([zlib.crc32(picture.tobytes()) % 4 for picture in observations["view"]])


def careless(evaluation):
    """Takes the shortest path from some pictures, and any move from the others."""
    right = shortest_path(evaluation)

    def act(observations):
        lost = np.array([zlib.crc32(picture.tobytes()) % 7 < 4 for picture in observations["view"]])
        return np.where(lost, scrambled(observations), right(observations))

    return act


def always(action):
    return lambda observations: np.full(len(observations["view"]), action)


def looped(world, act, frame_stack, options):
    """The same by single episodes, with frames stacked as for an encoder."""
    env = MazeEnv(world, evaluation=True, **options)
    pixels = env.observation_space.shape[1]
    spec = DataSpec({"view": ArraySpec((3 * frame_stack, pixels, pixels))}, frame_stack=frame_stack)
    wrapped = PrepareObservation(env, spec)
    returns, successes, moves = [], [], []
    for cell in set(range(env.maze.cells)) - {env.maze.centre}:
        seen, _ = wrapped.reset(seed=0, options={"start": "{},{}".format(*env.maze.place(cell))})
        rewards, ended = [], False
        while not ended:
            action = act({name: array[None] for name, array in seen.items()})[0]
            seen, reward, reached, truncated, _ = wrapped.step(action)
            rewards.append(reward)
            ended = reached or truncated
        returns.append(sum(rewards))
        successes.append(reached)
        moves.append(len(rewards))
    return {"return": np.mean(returns), "success": np.mean(successes), "moves": np.mean(moves)}


@pytest.mark.parametrize("world", WORLDS)
@pytest.mark.parametrize("frame_stack", [1, 2])
def test_a_perfect_policy_solves_every_maze(world, frame_stack):
    evaluation = MazeEvaluation(world, {"size": 6, "cell_pixels": 3}, "view", frame_stack)
    maze = evaluation.mazes.maze
    moves = np.delete(maze.distances[maze.centre], maze.centre)
    found = evaluation.run(shortest_path(evaluation))
    assert found == pytest.approx({"return": -(moves - 1).mean(), "success": 1.0, "moves": moves.mean()})
    assert evaluation.shortest == pytest.approx(moves.mean())


@pytest.mark.parametrize("world", WORLDS)
@pytest.mark.parametrize("frame_stack", [1, 2])
def test_any_policy_scores_as_in_single_episodes(world, frame_stack):
    evaluation = MazeEvaluation(world, SMALL, "view", frame_stack)
    act = careless(evaluation)
    found = evaluation.run(act)
    assert found == pytest.approx(looped(world, act, frame_stack, SMALL))
    assert 0 < found["success"] < 1 and 1 < found["moves"] < 14


@pytest.mark.parametrize("world", WORLDS)
def test_a_policy_that_runs_into_walls_fails_but_beside_the_goal(world):
    evaluation = MazeEvaluation(world, SMALL, "view", 1)
    maze = evaluation.mazes.maze
    for action in range(4):
        cells, reached = np.arange(maze.cells), np.zeros(maze.cells, bool)
        for _ in range(maze.size):
            cells = np.where(reached, cells, maze.neighbours[cells, action])
            reached |= cells == maze.centre
        wanted = np.delete(reached, maze.centre).mean()
        assert evaluation.run(always(action))["success"] == pytest.approx(wanted) and wanted < 0.5


def test_goals_and_starts_of_the_training_are_replaced_and_the_rest_is_kept():
    training = {**SMALL, "goals": "0,0", "start": "3,3", "show_walls": True}
    evaluation = MazeEvaluation("GridWorld", training, "view", 1)
    assert evaluation.mazes.start is None and evaluation.mazes.goal_cells.tolist() == [evaluation.mazes.maze.centre]
    assert evaluation.run(always(0)) == MazeEvaluation("GridWorld", SMALL, "view", 1).run(always(0))
    assert len(evaluation.mazes.painter._walls) == 0  # GridWorld has none inside
    assert len(MazeEvaluation("SpiralWorld", training, "view", 1).mazes.painter._walls) > 0
    assert MazeEvaluation("GridWorld", {**training, "goals": "none"}, "view", 1).run(always(1))["success"] > 0


def test_only_mazes_that_go_on_are_shown_to_the_policy():
    evaluation = MazeEvaluation("GridWorld", SMALL, "view", 1)
    act, counts = shortest_path(evaluation), []

    def counting(observations):
        counts.append(len(observations["view"]))
        return act(observations)

    found = evaluation.run(counting)
    assert counts[0] == 15 and counts == sorted(counts, reverse=True)
    assert sum(counts) == pytest.approx(15 * found["moves"])


def test_the_backgrounds_are_those_of_evaluation_and_the_same_every_time():
    evaluation = MazeEvaluation("SpiralWorld", {**SMALL, "distractors": "procedural"}, "view", 2)
    training = MazeBatch(1, "SpiralWorld", **SMALL, distractors="procedural")
    shown: list[list[bytes]] = [[], []]
    for run in range(2):
        np.random.seed(run)  # noqa: NPY002 (nothing global may matter)
        evaluation.run(lambda seen, run=run: shown[run].append(seen["view"].tobytes()) or scrambled(seen))
        assert not set(evaluation.mazes.factors()["clip"]) & set(training._clip_numbers)
    assert shown[0] == shown[1] and len(set(shown[0])) == len(shown[0]) == SMALL["episode_length"]
    assert len(set(evaluation.mazes.factors()["clip"])) > 1


class Countdown(gymnasium.Env[Any, Any]):
    """Episodes of 1, 2, 3, ... steps, from the seed on; the action is the reward."""

    observation_space = Dict({"view": Box(0, 255, (1, 2, 2), np.uint8)})
    action_space = Discrete(4)

    def __init__(self) -> None:
        self.seeds: list[int | None] = []

    def reset(self, *, seed=None, options=None):
        self.seeds.append(seed)
        self._length = 1 if seed is not None else self._length + 1
        self._left = self._length
        return self._seen(), {}

    def _seen(self):
        return {"view": np.full((1, 2, 2), self._left, np.uint8)}

    def step(self, action):
        self._left -= 1
        ended = self._left == 0
        return self._seen(), float(action), ended and self._length % 2 == 0, ended and self._length % 2 == 1, {}


def test_other_environments_play_ten_episodes_the_same_every_time():
    env = Countdown()
    spec = DataSpec({"view": ArraySpec((1, 2, 2))})
    evaluation = EpisodeEvaluation(PrepareObservation(env, spec), seed=5)
    steps = sum(range(1, 11))
    ones = sum(left == 1 for length in range(1, 11) for left in range(1, length + 1))
    for _ in range(2):
        found = evaluation.run(lambda seen: (seen["view"][:, 0, 0, 0] == 1).astype(int))
        assert found == pytest.approx({"return": ones / 10, "moves": steps / 10})
    assert env.seeds == [5, *[None] * 9] * 2
