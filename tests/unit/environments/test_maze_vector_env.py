"""n mazes at once do what n mazes do one by one."""

from __future__ import annotations

import gymnasium
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode

from repdib_lightning.environments import register
from repdib_lightning.environments.maze_env import MazeEnv
from repdib_lightning.environments.maze_vector_env import MazeVectorEnv
from repdib_lightning.environments.mazes import WORLDS
from repdib_lightning.errors import UserError

N = 7
LEFT = 2


@pytest.fixture
def vector() -> MazeVectorEnv:
    return MazeVectorEnv(N, "LoopWorld", episode_length=12)


@pytest.mark.parametrize("world", WORLDS)
def test_made_by_gymnasium(world):
    register()
    made = gymnasium.make_vec(f"repdib/{world}-v0", num_envs=5, vectorization_mode="vector_entry_point", goals="2,2")
    assert isinstance(made, MazeVectorEnv) and made.maze.name == world
    assert made.metadata["autoreset_mode"] is AutoresetMode.NEXT_STEP
    observations, _ = made.reset(seed=0)
    one_by_one = gymnasium.make_vec(f"repdib/{world}-v0", num_envs=5, vectorization_mode="sync", goals="2,2")
    for name in ("observation_space", "action_space", "single_observation_space", "single_action_space"):
        assert getattr(made, name) == getattr(one_by_one, name)
    assert made.observation_space.contains(observations)
    assert made.spec.id == f"repdib/{world}-v0"
    for env in (made, one_by_one):
        env.close()


def place(single: MazeEnv, factors: dict[str, np.ndarray], i: int) -> tuple[np.ndarray, dict]:
    """Begin an episode of a single maze as maze i of a vector began it."""
    cells = {"start": factors["position"][i], **({"goal": factors["goal"][i]} if "goal" in factors else {})}
    return single.reset(options={name: single.maze.place(cell) for name, cell in cells.items()})


@pytest.mark.parametrize("options", [{}, {"goals": "none", "show_walls": True}, {"goals": "0,0 3,3", "size": 5}])
@pytest.mark.parametrize("world", WORLDS)
def test_steps_are_those_of_single_mazes(world, options):
    """Single mazes are placed where the vector's mazes begin, again and again; everything in between agrees."""
    vector = MazeVectorEnv(N, world, episode_length=12, **options)
    singles = [MazeEnv(world, episode_length=12, **options) for _ in range(N)]
    seen, infos = vector.reset(seed=2)
    outcomes = [place(single, infos["factors"], i) for i, single in enumerate(singles)]
    random = np.random.default_rng(0)
    ended, ends = np.zeros(N, bool), 0
    for _ in range(40):
        for i, (picture, info) in enumerate(outcomes):
            assert np.array_equal(seen[i], picture)
            assert {name: infos["factors"][name][i] for name in info["factors"]} == info["factors"]
        actions = random.integers(4, size=N)
        seen, *results, infos = vector.step(actions)
        assert all(infos[mask].all() for mask in infos if mask[0] == "_")
        for i, single in enumerate(singles):
            expected = (0.0, False, False)
            if ended[i]:
                outcomes[i] = place(single, infos["factors"], i)
            else:
                picture, *expected, info = single.step(actions[i])
                outcomes[i] = picture, info
            assert [result[i] for result in results] == list(expected)
        ended = results[1] | results[2]
        ends += ended.sum()
    assert ends > N


def test_backgrounds_play_on_in_each_maze(vector):
    vector = MazeVectorEnv(N, distractors="procedural", goals="none", cell_pixels=3)
    seen, infos = vector.reset(seed=0)
    clips = infos["factors"]["clip"]
    assert len(set(clips)) > 1
    after, *_, infos = vector.step(np.zeros(N, int))
    assert np.array_equal(infos["factors"]["clip"], clips)
    changed = (seen != after).any(axis=(1, 2, 3))
    assert changed.all()


def test_a_seed_decides_all_mazes(vector):
    def play(seed: int) -> list[bytes]:
        seen = [vector.reset(seed=seed)[0]]
        return [picture.tobytes() for picture in (*seen, *(vector.step(np.full(N, 3))[0] for _ in range(20)))]

    assert play(1) == play(1) and play(1)[0] != play(2)[0]
    assert len({picture.tobytes() for picture in vector.reset(seed=1)[0]}) > 1, "the mazes differ"


def test_observations_that_were_returned_do_not_change(vector):
    first, infos = vector.reset(seed=0)
    kept, position = first.copy(), infos["factors"]["position"].copy()
    for action in range(4):
        vector.step(np.full(N, action))
    assert np.array_equal(first, kept) and np.array_equal(infos["factors"]["position"], position)


def test_a_mask_resets_some(vector):
    vector.reset(seed=0)
    for _ in range(3):
        vector.step(np.full(N, 1))
    before = vector.batch.factors()
    mask = np.arange(N) < 3
    seen, infos = vector.reset(options={"reset_mask": mask, "start": "1,1", "goal": "centre"})
    assert seen.shape[0] == N
    assert vector.batch.cells[:3].tolist() == [7] * 3 and vector.batch.steps.tolist() == [0] * 3 + [3] * (N - 3)
    assert np.array_equal(vector.batch.cells[3:], before["position"][3:])
    factors = infos["factors"]
    assert np.array_equal(infos["_factors"], mask) and np.array_equal(factors["_goal"], mask)
    assert factors["position"].tolist() == [7] * 3 + [0] * (N - 3)


def test_a_masked_reset_ends_the_wait_for_a_new_episode(vector):
    vector.reset(options={"start": "3,3", "goal": "centre"})
    assert vector.step(np.full(N, LEFT))[2].all()
    vector.reset(options={"reset_mask": np.arange(N) == 0, "start": "3,3", "goal": "centre"})
    _, rewards, terminated, _, _ = vector.step(np.full(N, LEFT))
    assert terminated.tolist() == [True] + [False] * (N - 1) and vector.batch.steps.tolist() == [1] + [0] * (N - 1)
    assert rewards.tolist() == [0.0] * N


def test_a_policy_is_tried_from_every_cell_at_once():
    starts = [cell for cell in range(36) if cell != 20]
    vector = MazeVectorEnv(len(starts), "SpiralWorld", evaluation=True)
    maze = vector.maze
    _, infos = vector.reset(options={"start": [maze.place(cell) for cell in starts]})
    assert infos["factors"]["position"].tolist() == starts and set(infos["factors"]["goal"]) == {20}
    steps, returns, running = np.zeros(len(starts), int), np.zeros(len(starts)), np.ones(len(starts), bool)
    for _ in range(35):
        position = infos["factors"]["position"]
        actions = maze.distances[maze.neighbours[position], 20].argmin(axis=1)
        _, rewards, terminated, truncated, infos = vector.step(actions)
        steps, returns = steps + running, returns + rewards * running
        running &= ~(terminated | truncated)
    assert not running.any()
    assert np.array_equal(steps, maze.distances[starts, 20]) and np.array_equal(returns, 1.0 - steps)


def test_cells_may_be_an_array(vector):
    cells = np.stack([np.zeros(N, int), np.arange(N) % 6], axis=1)
    _, infos = vector.reset(options={"start": cells, "goal": np.array([5, 5])})
    assert infos["factors"]["position"].tolist() == (np.arange(N) % 6).tolist()
    assert set(infos["factors"]["goal"]) == {35}


def test_render_shows_each_maze():
    vector = MazeVectorEnv(2, evaluation=True, render_mode="rgb_array")
    vector.reset(options={"start": ["0,0", "5,5"]})
    frames = vector.render()
    single = MazeEnv(evaluation=True, render_mode="rgb_array")
    for frame, start in zip(frames, ("0,0", "5,5"), strict=True):
        single.reset(options={"start": start})
        assert np.array_equal(frame, single.render())
    assert MazeVectorEnv(2).render() is None


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"start": ["0,0", "0,1"]}, f"start: names 2 cells for {N} mazes"),
        ({"start": []}, f"start: names 0 cells for {N} mazes"),
        ({"start": ["0,0"] * (N - 1) + ["3,2"], "goal": "centre"}, "start=3,2: is also the goal"),
        ({"goal": "0,6"}, "goal=0,6: lies outside"),
        ({"reset_mask": [True] * N}, "reset_mask: expected a numpy array"),
        ({"reset_mask": np.zeros(N, bool)}, "at least one of them True"),
        ({"reset_mask": np.ones(N - 1, bool)}, f"array of {N} booleans"),
        ({"mask": np.ones(N, bool)}, "unknown option 'mask'"),
    ],
)
def test_bad_options_of_reset_are_named(vector, options, said):
    vector.reset(seed=0)
    with pytest.raises(UserError, match=said):
        vector.reset(options=options)


def test_the_first_reset_is_of_all_mazes(vector):
    with pytest.raises(UserError, match="first reset must be of all"):
        vector.reset(options={"reset_mask": np.arange(N) == 0})


@pytest.mark.parametrize("actions", [np.zeros(N - 1, int), np.zeros(1, int), np.zeros(N), np.full(N, 4), np.int64(0)])
def test_bad_actions_are_refused(vector, actions):
    vector.reset(seed=0)
    with pytest.raises(UserError, match="action"):
        vector.step(actions)


@pytest.mark.parametrize("arguments", [{"num_envs": 0}, {"render_mode": "human"}, {"world": "Loop"}])
def test_bad_arguments_are_named(arguments):
    with pytest.raises(UserError, match=str(next(iter(arguments.values())))):
        MazeVectorEnv(**arguments)
