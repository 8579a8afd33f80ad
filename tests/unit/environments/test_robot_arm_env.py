"""The gymnasium environment."""

from __future__ import annotations

import warnings

import gymnasium
import numpy as np
import pytest

from repdib_lightning.environments import register
from repdib_lightning.environments.robot_arm_env import RobotArmEnv
from repdib_lightning.errors import UserError


@pytest.fixture(scope="module")
def env():
    env = RobotArmEnv(image_size=32, episode_length=6, goal=7, recording=40, render_mode="rgb_array")
    yield env
    env.close()


def play(env: RobotArmEnv, actions: list[int]) -> tuple[list[dict[str, np.ndarray]], list[int]]:
    observations, cells = [], []
    for action in actions:
        observation, _, _, _, info = env.step(np.int64(action))
        observations.append(observation)
        cells.append(info["factors"]["cell"])
    return observations, cells


def test_passes_the_checker_through_gymnasium_make():
    from gymnasium.utils.env_checker import check_env

    register()
    register()
    made = gymnasium.make("repdib/RobotArm-v0", image_size=16, episode_length=5, render_mode="rgb_array")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warnings.filterwarnings("ignore", message=".*(image|channel|Box observation space).*")
        check_env(made.unwrapped)
    made.close()


def test_actions_lead_to_cells(env):
    env.reset(seed=0)
    assert play(env, [0, 2, 2, 1, 4, 3])[1] == [7, 6, 6, 3, 3, 4]


def test_reward_counts_steps_to_the_goal(env):
    env.reset(seed=0, options={"cell": 0})
    outcomes = [env.step(np.int64(action))[1:4] for action in (3, 0, 0)]
    assert outcomes == [(-1.0, False, False), (-1.0, False, False), (0.0, True, False)]


def test_without_a_goal_there_is_no_reward_and_only_truncation():
    free = RobotArmEnv(image_size=16, episode_length=3)
    free.reset(seed=1)
    assert [free.step(np.int64(0))[1:4] for _ in range(3)] == [(0.0, False, False)] * 2 + [(0.0, False, True)]
    assert free.render() is None
    free.close()


def test_a_seeded_reset_repeats_everything_and_an_unseeded_one_goes_on(env):
    runs = []
    for _ in range(2):
        first, info = env.reset(seed=5)
        observations, _ = play(env, [0, 1, 2])
        later, later_info = env.reset()
        runs.append(([first, *observations, later], info, later_info))
    for one, other in zip(runs[0][0], runs[1][0], strict=True):
        assert all(np.array_equal(one[name], other[name]) for name in ("front", "top"))
    _, info, later_info = runs[0]
    assert info["factors"]["time_step"] == 0.0
    assert later_info["factors"]["time_step"] == pytest.approx(3 / 40)


def test_daylight_drifts_back_after_the_recording(env):
    env.reset(seed=0)
    times = []
    for _ in range(12):
        play(env, [4] * 6)
        times.append(env.reset()[1]["factors"]["time_step"])
    assert np.allclose(times[5:8], [36 / 40, 38 / 40, 32 / 40])


def test_render_shows_both_views_side_by_side(env):
    observation, _ = env.reset(seed=2)
    frame = env.render()
    assert frame.shape == (32, 64, 3)
    assert np.array_equal(frame[:, :32], observation["front"].transpose(1, 2, 0))
    assert np.array_equal(frame[:, 32:], observation["top"].transpose(1, 2, 0))


def test_evaluation_plays_other_clips():
    videos = []
    for evaluation in (False, True):
        env = RobotArmEnv(image_size=16, episode_length=200, evaluation=evaluation)
        env.reset(seed=0)
        videos.append(set(env._factors["video"]))
        env.close()
    assert videos[0] <= set(range(12)) and videos[1] <= set(range(12, 16))


@pytest.mark.parametrize(
    ("arguments", "said"),
    [({"goal": 9}, "goal=9"), ({"episode_length": 0}, "episode_length=0"), ({"render_mode": "human"}, "render_mode")],
)
def test_bad_arguments_are_named(arguments, said):
    with pytest.raises(UserError, match=said):
        RobotArmEnv(**arguments)


def test_bad_starting_cell_is_named(env):
    with pytest.raises(UserError, match="cell=-1"):
        env.reset(options={"cell": -1})
