"""Tasks of the Control Suite: names, action repeat, ends of episodes, repeatable starts, and what bad input says."""

from __future__ import annotations

import logging
import os
import subprocess
import sys

import numpy as np
import pytest

from repdib_lightning.environments import rendering
from repdib_lightning.environments.control_state_env import ControlStateEnv
from repdib_lightning.environments.control_task import ControlTask, load_suite
from repdib_lightning.errors import UserError

ONE_OF_EACH = (
    "acrobot-swingup", "ball_in_cup-catch", "cartpole-swingup", "cheetah-run", "dog-fetch", "finger-turn_hard",
    "fish-swim", "hopper-hop", "humanoid-walk", "humanoid_CMU-run", "manipulator-bring_ball", "pendulum-swingup",
    "point_mass-hard", "quadruped-fetch", "reacher-hard", "stacker-stack_2", "swimmer-swimmer6", "walker-walk",
)  # fmt: skip


def played(task: ControlTask, seed: int, actions: np.ndarray) -> list[tuple[list[float], float]]:
    """States and rewards of an episode's beginning."""
    task.reset(np.random.default_rng(seed))
    start = [(task.state().tolist(), 0.0)]
    return start + [(task.state().tolist(), reward) for reward, *_ in map(task.step, actions)]


def test_every_domain_that_ends_is_tried_here():
    assert {name.split("-")[0] for name in ONE_OF_EACH} == {domain for domain, _ in load_suite().ALL_TASKS} - {"lqr"}


@pytest.mark.parametrize("name", ONE_OF_EACH)
def test_a_start_depends_on_the_seed_alone(name):
    task = ControlTask(name, 3)
    actions = np.random.default_rng(0).uniform(-1, 1, (3, task.actions))
    first, other, again = (played(task, seed, actions) for seed in (5, 6, 5))
    assert first == again and first[0] != other[0]
    assert np.isfinite([state for state, _ in first]).all()
    assert len(first[0][0]) == sum(task.sizes.values())
    assert {key: value.shape for key, value in task.factors().items()} == {k: (n,) for k, n in task.sizes.items()}


def test_rewards_are_summed_over_the_action_repeat():
    single, held = ControlTask("walker-walk", 1), ControlTask("walker-walk", 4)
    for task in (single, held):
        task.reset(np.random.default_rng(3))
    for action in np.random.default_rng(4).uniform(-1, 1, (5, 6)):
        rewards = [single.step(action)[0] for _ in range(4)]
        assert held.step(action)[0] == pytest.approx(sum(rewards), abs=1e-12) and len(set(rewards)) > 1
        assert np.array_equal(held.state(), single.state())


@pytest.mark.parametrize(("repeat", "steps"), [(20, 50), (300, 4), (999, 2), (1000, 1), (5000, 1)])
def test_episodes_are_truncated_after_1000_control_steps(repeat, steps):
    task = ControlTask("pendulum-swingup", repeat)
    for _ in range(2):
        task.reset(np.random.default_rng(0))
        ends = [task.step(np.zeros(1))[1:] for _ in range(task.steps)]
        assert ends == [(False, False)] * (steps - 1) + [(False, True)]
        assert task.data.time == pytest.approx(1000 * 0.02)
    assert task.steps == steps


def test_actions_are_scaled_to_the_tasks_own_bounds_and_clipped():
    task = ControlTask("quadruped-walk", 1)
    bounds = task.model.actuator_ctrlrange
    assert not np.allclose(np.abs(bounds), 1)
    for sign, expected in ((-1.0, bounds[:, 0]), (1.0, bounds[:, 1]), (0.0, bounds.mean(1)), (7.0, bounds[:, 1])):
        task.reset(np.random.default_rng(0))
        task.step(np.full(task.actions, sign, np.float32))
        assert np.allclose(task.data.ctrl, expected)


def test_names_as_other_data_sets_write_them():
    assert ControlTask("walker_walk", 20).name == "walker-walk"
    assert ControlTask("ball_in_cup_catch", 20).name == ControlTask("ball_in_cup-catch", 20).name == "ball_in_cup-catch"
    assert ControlTask("quadruped_run", 20).camera == 2 and ControlTask("cheetah_run", 20).camera == 0


@pytest.mark.parametrize(
    ("name", "repeat", "said"),
    [
        ("walkr-walk", 2, r"task walkr-walk: unknown domain 'walkr', did you mean 'walker'\? \(choices: acrobot, "),
        ("walker-wlk", 2, r"task walker-wlk: unknown, did you mean 'walker-walk'\? \(choices: walker-flip, "),
        ("cheetah_rn", 2, r"task cheetah_rn: unknown, did you mean 'cheetah-run'\?"),
        ("cheetah", 2, r"task cheetah: unknown, (did you mean 'cheetah-run'|choices: cheetah-run)"),
        ("", 2, r"task : unknown, choices: "),
        ("lqr-lqr_2_1", 2, r"task lqr-lqr_2_1: its episodes never end"),
        ("walker-walk", 0, r"action_repeat=0: must be at least 1"),
    ],
)
def test_bad_input_is_one_line_with_the_nearest_choice(name, repeat, said):
    with pytest.raises(UserError, match=said) as caught:
        ControlTask(name, repeat)
    assert "\n" not in str(caught.value)


def test_mujoco_4_is_refused(monkeypatch):
    monkeypatch.setattr(rendering.prepare_rendering(), "__version__", "4.0.1")
    with pytest.raises(UserError, match=r"mujoco 4.0.1 is installed.*>=3.17,<4"):
        ControlTask("walker-walk")


@pytest.mark.parametrize(
    ("variable", "value"), [("PYOPENGL_PLATFORM", "glx"), ("MUJOCO_EGL_DEVICE_ID", "99"), ("MUJOCO_GL", "glfw")]
)
def test_without_a_renderer_one_line_says_where_to_get_one(variable, value, tmp_path):
    kept = {key: text for key, text in os.environ.items() if key not in ("MUJOCO_GL", "PYOPENGL_PLATFORM")}
    command = [sys.executable, "-m", "repdib_lightning", "collect", "control", "x.h5", "--behaviour", "random"]
    done = subprocess.run(command, cwd=tmp_path, env=kept | {variable: value}, capture_output=True, text=True)
    assert done.returncode == 2 and len(done.stderr.splitlines()) == 1
    if variable == "MUJOCO_GL":
        assert "MUJOCO_GL=glfw: not a headless renderer" in done.stderr
    else:
        assert "MUJOCO_GL=egl: cannot render" in done.stderr and "apt-get install libegl1" in done.stderr
    assert not list(tmp_path.iterdir())


def test_what_the_suites_own_files_are_warned_of_is_not_shown(caplog):
    from absl import logging as absl_logging

    ControlTask("cheetah-run", 20)
    assert not caplog.records
    with caplog.at_level(logging.WARNING, "absl"):
        absl_logging.warning("attribute 'x' is deprecated and will be removed in a future release")
    assert "deprecated" in caplog.text, "only what is said while a task is loaded is kept back"


def test_states_as_an_environment():
    env = ControlStateEnv("walker_walk", 20)
    first, _ = env.reset(seed=3)
    again, _ = env.reset(seed=3)
    assert np.array_equal(first, again) and env.observation_space.contains(first)
    assert not np.array_equal(env.reset()[0], first), "the next episode starts elsewhere"
    steps, ended, total = 0, False, 0.0
    while not ended:
        state, reward, terminated, truncated, _ = env.step(env.action_space.sample())
        steps, ended, total = steps + 1, terminated or truncated, total + reward
    assert steps == 50 and truncated and not terminated
    assert np.array_equal(state, env.task.state()) and 0 < total < 1000
