"""URLB's twelve tasks: rewards by hand, published floors, repeatable starts, what is seen, and gymnasium's names."""

from __future__ import annotations

import math
import subprocess
import sys
import warnings
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from repdib_lightning.data.episodes import EpisodeStore
from repdib_lightning.environments import GYMNASIUM_IDS, register
from repdib_lightning.environments.collect_control import collect_control
from repdib_lightning.environments.control_env import ControlEnv
from repdib_lightning.environments.control_state_env import ControlStateEnv
from repdib_lightning.environments.control_task import ControlTask
from repdib_lightning.environments.rendering import prepare_rendering
from repdib_lightning.environments.urlb_tasks import URLB_TASKS, domain_of
from repdib_lightning.errors import UserError
from repdib_lightning.rl.environment import open_environment

WIDTHS = {"walker": (6, 24, 1000), "quadruped": (12, 78, 1000), "jaco": (9, 55, 250)}
"""Of actions and of the state, and control steps of an episode."""

ONE_OF_EACH = ("walker-flip", "quadruped-jump", "jaco-reach_top_left")
SIDES = {"top": (1, 0.09), "bottom": (1, -0.09), "left": (0, -0.09), "right": (0, 0.09)}
"""Word in a task's name -> axis and where along it the brick is, in metres."""


class Seeded:
    """Stands in for a generator, so that dm_control's own seed is the one that is given."""

    def __init__(self, seed: int) -> None:
        self.seed = seed

    def integers(self, high: int) -> int:
        return self.seed


def zeroed(name: str) -> ControlTask:
    """A task with everything in MuJoCo's reference pose, at rest."""
    task = ControlTask(name, 1)
    prepare_rendering().mj_resetData(task.model, task.data)
    return task


def reward(task: ControlTask) -> float:
    """What the task gives for the state as it has been set."""
    prepare_rendering().mj_forward(task.model, task.data)
    return float(task._environment.task.get_reward(task._environment.physics))


def joint(task: ControlTask, name: str) -> Any:
    return task.data.joint(name)


def played(task: ControlTask, seed: int, actions: np.ndarray) -> list[list[float]]:
    """Everything MuJoCo integrates, the factors and the rewards of an episode's beginning."""
    task.reset(np.random.default_rng(seed))
    rows = []
    for action in (None, *actions):
        gained = 0.0 if action is None else task.step(action)[0]
        data = task.data
        parts = (data.qpos, data.qvel, data.act, data.qacc_warmstart, task.state(), [gained, data.time])
        rows.append(np.concatenate(parts).tolist())
    return rows


def finished(task: ControlTask) -> float:
    """Return of the rest of an episode without actions; that it ends at the limit of time is checked."""
    total = 0.0
    while True:
        gained, terminated, truncated = task.step(np.zeros(task.actions))
        total += gained
        assert not terminated
        if truncated:
            return total


@pytest.mark.parametrize("name", URLB_TASKS)
def test_widths_lengths_and_names(name):
    task = ControlTask(name.replace("-", "_", 1), 2)
    actions, state, steps = WIDTHS[domain_of(name)]
    assert (task.name, task.actions, sum(task.sizes.values()), task.steps) == (name, actions, state, steps // 2)
    assert task.state().shape == (state,) and not any("/" in factor for factor in task.sizes)
    task.reset(np.random.default_rng(0))
    ends = [task.step(np.zeros(actions))[1:] for _ in range(task.steps)]
    assert ends == [(False, False)] * (task.steps - 1) + [(False, True)]


@pytest.mark.parametrize("name", URLB_TASKS)
def test_an_episode_depends_on_its_seed_and_actions_alone(name):
    """Whatever was played before, even an episode to its end: a run that was killed plays its episode again."""
    task, fresh = ControlTask(name, 2), ControlTask(name, 2)
    actions = np.random.default_rng(0).uniform(-1, 1, (40, task.actions))
    first = played(task, 5, actions)
    other = played(task, 6, actions[::-1])
    assert played(task, 5, actions) == first and other[0] != first[0]
    finished(task)
    assert played(task, 5, actions) == first
    played(fresh, 7, actions[:3])
    assert played(fresh, 5, actions) == first and np.isfinite(first).all()


@pytest.mark.parametrize("repeat", [1, 2])
@pytest.mark.parametrize(
    ("name", "published", "tolerance"),
    [
        # To three digits; a fall enlarges what differs in the last bits between machines.
        ("walker-walk", 18.2, 0.1),
        ("walker-flip", 18.4, 0.1),
        ("quadruped-jump", 734.0, 1.0),
        *((name, 0.0, 1e-3) for name in URLB_TASKS if name.startswith("jaco")),
    ],
)
def test_doing_nothing_from_seed_0_returns_what_is_published(name, published, tolerance, repeat):
    task = ControlTask(name, repeat)
    task.reset(Seeded(0))  # type: ignore[arg-type]
    assert finished(task) == pytest.approx(published, abs=tolerance)


@pytest.mark.parametrize(
    ("task", "speed", "moved"),
    [
        ("walk", 0.0, 0.0), ("walk", 0.5, 0.5), ("walk", 0.75, 0.75), ("walk", 1.0, 1.0), ("walk", 3.0, 1.0),
        ("walk", -1.0, 0.0), ("run", 0.0, 0.0), ("run", 4.0, 0.5), ("run", 6.0, 0.75), ("run", 8.0, 1.0),
    ],
)  # fmt: skip
def test_walker_upright_at_a_speed(task, speed, moved):
    walker = zeroed(f"walker-{task}")
    joint(walker, "rootx").qvel = speed
    assert reward(walker) == pytest.approx((5 * moved + 1) / 6)
    joint(walker, "rooty").qpos = math.pi
    assert reward(walker) == pytest.approx(0.75 * (5 * moved + 1) / 6)


@pytest.mark.parametrize(
    ("height", "angle", "expected"),
    [
        (1.3, 0.0, 1.0),
        (1.2, 0.0, 1.0),
        (0.6, 0.0, (3 * 0.1 + 1) / 4),
        (0.9, 0.0, (3 * 0.1**0.25 + 1) / 4),  # a Gaussian: 0.1 to the square of the share of the margin
        (1.3, math.pi, 0.75),
        (1.3, math.pi / 2, (3 + 0.5) / 4),
        (0.6, math.pi, 0.075),
    ],
)
def test_walker_stands(height, angle, expected):
    walker = zeroed("walker-stand")
    joint(walker, "rootz").qpos = height - 1.3  # its own height in the model
    joint(walker, "rooty").qpos = angle
    assert reward(walker) == pytest.approx(expected)
    assert walker.data.body("torso").xpos[2] == pytest.approx(height)


def inertia(task: ControlTask) -> float:
    """Of the whole body about the lateral axis through its centre of mass, by Steiner's theorem."""
    model, data = task.model, task.data
    prepare_rendering().mj_forward(model, data)
    masses = model.body_mass[:, None]
    away = data.xipos - (masses * data.xipos).sum(0) / masses.sum()
    frames = data.ximat.reshape(-1, 3, 3)
    own = (frames[:, 1] ** 2 * model.body_inertia).sum()
    return float(own + (model.body_mass * (away[:, 0] ** 2 + away[:, 2] ** 2)).sum())


@pytest.mark.parametrize(
    ("momentum", "spin"), [(0.0, 0.0), (1.0, 0.2), (2.5, 0.5), (4.9, 0.98), (5.0, 1.0), (9.0, 1.0), (-5.0, 0.0)]
)
def test_walker_flips_forward(momentum, spin):
    walker = zeroed("walker-flip")
    joint(walker, "rooty").qvel = momentum / inertia(walker)
    assert reward(walker) == pytest.approx((5 * spin + 1) / 6)
    joint(walker, "rootx").qvel = 3.0  # moving along is no spin
    assert reward(walker) == pytest.approx((5 * spin + 1) / 6)
    joint(walker, "rootz").qpos = -0.7
    assert reward(walker) == pytest.approx((3 * 0.1 + 1) / 4 * (5 * spin + 1) / 6)


TILTED = ((0.0, 1.0), (math.pi / 3, 0.75), (math.pi / 2, 0.5), (math.pi, 0.0))
"""Angle from upright in radians, and what standing at it gives."""


def tilt(task: ControlTask, angle: float) -> None:
    joint(task, "root").qpos[3:] = (math.cos(angle / 2), math.sin(angle / 2), 0, 0)


@pytest.mark.parametrize(("angle", "upright"), TILTED)
def test_quadruped_stands(angle, upright):
    quadruped = zeroed("quadruped-stand")
    tilt(quadruped, angle)
    for height in (0.3, 2.0):
        joint(quadruped, "root").qpos[2] = height
        assert reward(quadruped) == pytest.approx(upright, abs=1e-9)


@pytest.mark.parametrize(("angle", "upright"), TILTED)
@pytest.mark.parametrize(("height", "lifted"), [(0.0, 0.5), (0.5, 0.75), (0.9, 0.95), (1.0, 1.0), (1.7, 1.0)])
def test_quadruped_jumps(angle, upright, height, lifted):
    quadruped = zeroed("quadruped-jump")
    tilt(quadruped, angle)
    reward(quadruped)
    masses = quadruped.model.body_mass
    joint(quadruped, "root").qpos[2] += height - (masses * quadruped.data.xipos[:, 2]).sum() / masses.sum()
    assert reward(quadruped) == pytest.approx(upright * lifted, abs=1e-9)


@pytest.mark.parametrize(
    ("task", "speed", "moved"),
    [
        ("walk", 0.0, 0.5), ("walk", 0.25, 0.75), ("walk", 0.5, 1.0), ("walk", -0.5, 0.0),
        ("run", 0.0, 0.5), ("run", 2.5, 0.75), ("run", 5.0, 1.0),
    ],
)  # fmt: skip
def test_quadruped_upright_at_a_speed(task, speed, moved):
    quadruped = zeroed(f"quadruped-{task}")
    joint(quadruped, "root").qvel[0] = speed
    assert reward(quadruped) == pytest.approx(moved)


def test_the_quadrupeds_floor():
    for task, size in (("stand", 10), ("walk", 10), ("run", 100), ("jump", 10)):
        assert ControlTask(f"quadruped-{task}").model.geom("floor").size[:2].tolist() == [size, size]


def test_jaco_reaches():
    jaco = ControlTask("jaco-reach_bottom_left", 1)
    fingers = jaco.factors()["jaco_hand_pinch_site_pos"]
    brick = int(jaco.model.jnt_qposadr[jaco.model.jnt_type == 0][0])  # the only joint that is free
    for distance, expected in ((0.0, 1.0), (0.049, 1.0), (0.075, 0.1**0.25), (0.1, 0.1), (0.15, 1e-4)):
        for direction in ((1, 0, 0), (0, -1, 0), (0, 0, 1), (0.6, 0, -0.8)):
            jaco.data.qpos[brick : brick + 3] = fingers + distance * np.array(direction)
            assert reward(jaco) == pytest.approx(expected, rel=1e-4), (distance, direction)


@pytest.mark.parametrize("name", [name for name in URLB_TASKS if name.startswith("jaco")])
def test_jacos_starts(name):
    task = ControlTask(name, 1)
    fingers, turns = [], []
    for seed in range(12):
        task.reset(np.random.default_rng(seed))
        seen = task.factors()
        fingers.append(seen["jaco_hand_pinch_site_pos"])
        for word in name.partition("reach_")[2].split("_"):
            axis, where = SIDES[word]
            assert seen["duplo2x4_position"][axis] == pytest.approx(where, abs=1e-4)
        assert abs(seen["duplo2x4_position"][2] - 0.012) < 1e-3, "it rests on the floor"
        assert np.abs(seen["duplo2x4_linear_velocity"]).max() < 1e-3
        turn = seen["duplo2x4_orientation"]
        assert turn[1] == pytest.approx(0, abs=1e-3) and turn[2] == pytest.approx(0, abs=1e-3), "it stands"
        turns.append(2 * math.atan2(turn[3], turn[0]) % (2 * math.pi))
    assert (np.abs(np.array(fingers) - (0, 0, 0.3)) <= 0.1 + 1e-6).all() and np.ptp(fingers, axis=0).min() > 0.08
    assert np.histogram(turns, 4, (0, 2 * math.pi))[0].min() > 0, "it is turned in every direction"


def test_jacos_camera_is_in_front_of_it():
    """Left and right, near and far, as the tasks' names have them; the model is compiled once."""
    where = {}
    for name in URLB_TASKS[8:]:
        env = ControlEnv(name, image_size=64)
        model = env.task.model
        found = []
        for seed in range(8):
            observation, _ = env.reset(seed=seed)
            red = np.argwhere((observation[0] > 120) & (observation[1] < 60) & (observation[2] < 60))
            found += [red.mean(0)] if len(red) else []
        assert env.task.model is model and model.camera(env.task.camera).name == "front_close"
        where[name.partition("reach_")[2]] = np.mean(found, axis=0)
        env.close()
    rows, columns = ({word: at[axis] for word, at in where.items()} for axis in (0, 1))
    assert max(rows["top_left"], rows["top_right"]) + 4 < min(rows["bottom_left"], rows["bottom_right"])
    assert (
        max(columns["top_left"], columns["bottom_left"]) < 28 < 36 < min(columns["top_right"], columns["bottom_right"])
    )


def test_starts_that_are_drawn_anew_are_not_warned_of(caplog):
    jaco = ControlTask("jaco-reach_top_left")
    jaco.reset(Seeded(14))  # type: ignore[arg-type]  # its first pose is out of the arm's reach
    assert not caplog.records and np.isfinite(jaco.state()).all()


@pytest.mark.parametrize("name", [*ONE_OF_EACH, "quadruped-run"])  # each scene: the others differ in goals alone
def test_distractors_are_seen_around_the_agent(name):
    size = 32
    plain = ControlEnv(name, image_size=size)
    bare = plain.reset(seed=2)[0]
    plain.close()
    for place in ("sky", "sky_floor", "side"):
        if (name, place) == ("quadruped-run", "sky"):  # its floor ends beyond the horizon
            with pytest.raises(UserError, match=r"nothing of the sky is seen in quadruped-run; choose sky_floor or si"):
                ControlEnv(name, image_size=size, distractors="image", place=place)
            continue
        env = ControlEnv(name, image_size=size, distractors="image", place=place)
        shown = env.reset(seed=2)[0]
        frame = env.backgrounds.frame(env._playing, 0).transpose(2, 0, 1)
        cut, agent = env.camera.see(env.task).through[..., 0], env.camera.agent_mask(env.task)
        if place == "side":
            assert np.array_equal(shown[..., :size], bare) and np.array_equal(shown[..., size:], frame)
        else:
            assert np.array_equal(shown[:, cut], frame[:, cut]) and agent.sum() > 8 and not (agent & cut).any()
            kept = ~cut if place == "sky" else agent
            assert np.array_equal(shown[:, kept], bare[:, kept])
            assert cut.mean() > (0.05 if place == "sky" else 0.7)
        env.close()


@pytest.mark.parametrize("name", ONE_OF_EACH)
def test_what_is_seen_depends_on_the_seed_alone(name):
    env, rows = ControlEnv(name, image_size=24, frame_stack=2, distractors="video"), []
    for seed in (3, 4, 3):
        observations = [env.reset(seed=seed)[0]]
        actions = np.random.default_rng(0).uniform(-1, 1, (5, env.task.actions))
        rows.append(observations + [env.step(action.astype(np.float32))[0] for action in actions])
    assert np.array_equal(rows[0], rows[2]) and not np.array_equal(rows[0][0], rows[1][0])
    env.close()


def short(name: str) -> str:
    return "".join(word[:1].upper() + word[1:] for part in name.split("-") for word in part.split("_"))


@pytest.mark.parametrize("name", URLB_TASKS)
def test_gymnasium_has_each_as_urlb_has_it(name):
    env = open_environment(short(name), {})
    actions, _, steps = WIDTHS[domain_of(name)]
    inner = env.unwrapped
    assert isinstance(inner, ControlEnv) and inner.task.name == name and inner.task.steps == steps // 2
    assert env.observation_space == gymnasium.spaces.Box(0, 255, (9, 84, 84), np.uint8)
    assert env.action_space == gymnasium.spaces.Box(-1.0, 1.0, (actions,), np.float32)
    observation, _ = env.reset(seed=0)
    assert env.observation_space.contains(observation) and observation.std() > 5
    assert f"repdib/{short(name)}-v0" in GYMNASIUM_IDS
    env.close()


@pytest.mark.parametrize("name", ONE_OF_EACH)
def test_passes_the_checker(name):
    register()
    made = gymnasium.make(f"repdib/{short(name)}-v0", image_size=36, render_mode="rgb_array")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warnings.filterwarnings("ignore", message=".*(image|channel|Box observation space|minimum width).*")
        check_env(made.unwrapped)
    made.close()


def test_urlbs_options_can_be_changed():
    options = {"image_size": 32, "frame_stack": 1, "action_repeat": 4, "distractors": "video", "place": "side"}
    env = open_environment("WalkerRun", options)
    assert env.observation_space.shape == (3, 32, 48) and env.unwrapped.task.steps == 250  # type: ignore[attr-defined]
    env.close()


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"task": "walker-walk"}, r"task=walker-walk: the task is walker-run; leave it out, or take repdib/Control-v0"),
        ({"world": "walker-walk"}, r"--env_options.world: no option of WalkerRun"),
        ({"frame_stak": 1}, r"--env_options.frame_stak: no option of WalkerRun, did you mean 'frame_stack'\?"),
        ({"frame_stack": "x"}, r"--env_options.frame_stack: expected int, got 'x'"),
        ({"frame_stack": 0}, r"--env WalkerRun: frame_stack=0: must be at least 1"),
    ],
)
def test_bad_options_are_one_line(options, said):
    with pytest.raises(UserError, match=said) as caught:
        open_environment("WalkerRun", options)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("walker-flp", r"task walker-flp: unknown, did you mean 'walker-flip'\?"),
        ("quadruped_jmp", r"task quadruped_jmp: unknown, did you mean 'quadruped-jump'\?"),
        ("jaco-reach_top_lft", r"task jaco-reach_top_lft: unknown, did you mean 'jaco-reach_top_left'\?"),
        ("jacco-reach_top_left", r"task jacco-reach_top_left: unknown domain 'jacco', did you mean 'jaco'\?"),
        ("walker-jump", r"task walker-jump: unknown, (did you mean|choices: walker-flip)"),
    ],
)
def test_an_unknown_task_lists_all_of_urlb(name, said):
    with pytest.raises(UserError, match=said) as caught:
        ControlTask(name)
    assert "\n" not in str(caught.value) and str(caught.value).endswith(f"URLB's: {', '.join(URLB_TASKS)}")


def test_domains():
    assert [domain_of(name) for name in URLB_TASKS] == ["walker"] * 4 + ["quadruped"] * 4 + ["jaco"] * 4
    assert domain_of("jaco_reach_bottom_left") == "jaco" and domain_of("ball_in_cup-catch") == "ball_in_cup"
    with pytest.raises(UserError, match=r"task walker_flp: .*did you mean 'walker-flip'\?"):
        domain_of("walker_flp")


def test_naming_the_tasks_opens_no_simulator():
    told = "import sys, repdib_lightning.environments as e; e.register(); print(*sorted(sys.modules))"
    loaded = subprocess.run([sys.executable, "-c", told], capture_output=True, text=True, check=True).stdout.split()
    assert "repdib_lightning.environments.urlb_tasks" in loaded and not {"dm_control", "mujoco", "torch"} & set(loaded)


def test_they_are_recorded_like_any_task(tmp_path):
    made = {"task": "jaco_reach_top_right", "behaviour": "random", "samples": 20, "image_size": 16, "action_repeat": 25}
    store = EpisodeStore(collect_control(tmp_path / "x.h5", progress=False, workers=1, **made))
    assert store.lengths.tolist() == [11, 11] and store.attributes["environment"] == "control"
    assert store.observations["pixels"].shape == (3, 16, 16), "never stacked"
    assert sum(factor.width for factor in store.factors.values()) == 55
    places = store.array("factors/duplo2x4_position")
    assert np.allclose(places[[0, 11], :2], 0.09, atol=1e-3)


def test_states_as_an_environment():
    env = ControlStateEnv("quadruped_jump", 50)
    first, _ = env.reset(seed=3)
    assert env.observation_space.contains(first) and first.shape == (78,) and env.action_space.shape == (12,)
    ends = [env.step(env.action_space.sample())[2:4] for _ in range(20)]
    assert ends == [(False, False)] * 19 + [(False, True)]
