"""The Control Suite amid distractors in gymnasium: what a seed decides, what plays, and what the factors say of it."""

from __future__ import annotations

import warnings
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from PIL import Image

from repdib_lightning.environments import register
from repdib_lightning.environments.control_env import ControlEnv
from repdib_lightning.environments.numbered_clips import NumberedClips
from repdib_lightning.errors import UserError

SIZE = 24
AMID = (
    {},
    {"distractors": "image"},
    {"distractors": "video"},
    {"distractors": "video", "place": "sky_floor"},
    {"distractors": "image", "place": "side"},
    {"distractors": "video", "quality": "paper"},
    {"quality": "paper"},
)


def make(**options: Any) -> ControlEnv:
    return ControlEnv(**{"image_size": SIZE, "action_repeat": 20, **options})


def played(env: ControlEnv, seed: int | None, steps: int = 4) -> list[tuple[np.ndarray, float, dict[str, np.ndarray]]]:
    """Observations, rewards and factors of an episode's beginning; always the same actions."""
    observation, info = env.reset(seed=seed)
    rows = [(observation, 0.0, info["factors"])]
    for action in np.random.default_rng(9).uniform(-1, 1, (steps, env.task.actions)):
        observation, reward, *_, info = env.step(action.astype(np.float32))
        rows.append((observation, reward, info["factors"]))
    return rows


def same(some: list[Any], others: list[Any]) -> bool:
    """Whether observations, rewards and every factor agree exactly."""
    return all(
        np.array_equal(one, two) and reward == other_reward and all(np.array_equal(f[k], g[k]) for k in f)
        for (one, reward, f), (two, other_reward, g) in zip(some, others, strict=True)
    )


@pytest.mark.parametrize("options", [AMID[0], AMID[3], AMID[4]])
def test_passes_the_checker_through_gymnasium_make(options):
    register()
    made = gymnasium.make("repdib/Control-v0", image_size=SIZE, action_repeat=20, render_mode="rgb_array", **options)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warnings.filterwarnings("ignore", message=".*(image|channel|Box observation space|minimum width).*")
        check_env(made.unwrapped)
    made.close()


@pytest.mark.parametrize("options", [AMID[2], AMID[4]])
def test_a_seed_decides_all_that_is_seen_whatever_ran_before(options):
    env = make(**options)
    first = played(env, 1) + played(env, None)
    other = played(env, 2)
    assert same(played(env, 1) + played(env, None), first)
    assert not np.array_equal(other[0][0], first[0][0]) and not np.array_equal(first[0][0], first[5][0])
    again = make(**options)
    assert same(played(again, 1), first[:5])
    env.close()
    again.close()


def test_movements_and_rewards_are_the_same_amid_anything():
    """In the episodes that follow without a seed, too."""
    envs = [make(**options) for options in AMID]
    episodes = [[row for seed in (5, None) for row in played(env, seed)] for env in envs]
    states = envs[0].task.sizes
    for env, rows in zip(envs, episodes, strict=True):
        for (observation, reward, factors), (_, expected, plain) in zip(rows, episodes[0], strict=True):
            assert reward == expected and all(np.array_equal(factors[name], plain[name]) for name in states)
            assert env.observation_space.contains(observation)
        assert rows[0][0].shape == (3, SIZE, SIZE * 3 // 2 if env.backgrounds.place == "side" else SIZE)
        assert rows[0][0].dtype == np.uint8 and {name: rows[0][2][name].size for name in states} == states
        assert env.render() is None and env.action_space == gymnasium.spaces.Box(-1.0, 1.0, (6,), np.float32)
        env.close()
    assert len({row[1] for row in episodes[0]}) > 8 and set(episodes[0][0][2]) == set(states)


@pytest.mark.parametrize(
    "options", [{"place": "sky"}, {"place": "sky_floor"}, {"place": "sky", "quality": "paper"}, {"place": "side"}]
)
def test_distractors_never_cover_the_agent(options):
    """Where nothing of the sky is mixed in, pixels are as without distractors."""
    env, plain = make(distractors="video", **options), make(quality=options.get("quality", "fast"))
    amid, bare = (played(one, 3)[-1][0][:, :, :SIZE].astype(int) for one in (env, plain))
    whole, agent = env.camera.see(env.task).through[..., 0] == 0, env.camera.agent_mask(env.task)
    kept = whole & agent if options["place"] == "sky_floor" else whole
    assert (kept & agent).sum() > 10 and whole.all() == (options["place"] == "side")
    assert np.abs(amid[:, kept] - bare[:, kept]).max() <= (1 if "quality" in options else 0)
    env.close()
    plain.close()


@pytest.mark.parametrize(("kind", "source"), [("image", "procedural_images"), ("video", "procedural")])
@pytest.mark.parametrize("place", ["sky_floor", "side"])
def test_factors_describe_what_is_seen(kind, source, place):
    env = make(distractors=kind, place=place, distractor_seed=4)
    width = SIZE // 2 if place == "side" else SIZE
    clips = NumberedClips(source, 4, size=(SIZE, width))
    observation, info = env.reset(seed=1)
    where = np.ones((SIZE, width), bool) if place == "side" else env.camera.see(env.task).through[..., 0]
    clip = clips.clip(int(info["factors"]["clip"]))
    matches = [np.array_equal(observation.transpose(1, 2, 0)[:, -width:][where], frame[where]) for frame in clip]
    assert sum(matches) == 1, "one frame of the clip that is named is seen"
    for step in range(4):
        frame = clip[(matches.index(True) + step * (kind == "video")) % len(clip)]
        where = where if place == "side" else env.camera.see(env.task).through[..., 0]
        assert np.array_equal(observation.transpose(1, 2, 0)[:, -width:][where], frame[where])
        ninths = info["factors"]["background"].reshape(3, 3, 3)
        assert np.allclose(ninths[0, 2], frame[: SIZE // 3, -(width // 3) :].mean((0, 1)) / 255, atol=0.05)
        assert np.allclose(ninths[1, 0], frame[8:16, : -(-width // 3)].mean((0, 1)) / 255, atol=1e-6)
        observation, *_, info = env.step(env.action_space.sample())
    env.close()


def painted_clips(folder: Any, frames: int) -> str:
    """Eight clips, each of frames of one colour: red tells the clip, blue the frame."""
    for clip in range(8):
        (folder / f"clip{clip}").mkdir(parents=True)
        for frame in range(frames):
            Image.new("RGB", (8, 8), (10 + 30 * clip, 0, 40 * frame)).save(folder / f"clip{clip}" / f"{frame}.png")
    return str(folder)


def colours(env: ControlEnv, episodes: int, steps: int) -> np.ndarray:
    """(episodes, steps + 1, 3): the colour at the right edge of each observation."""
    seeds = [0, *[None] * (episodes - 1)]
    return np.array([[row[0][:, 0, -1] for row in played(env, seed, steps)] for seed in seeds])


def test_an_image_stays_for_an_episode_and_the_next_one_shows_another(tmp_path):
    """One frame of a clip, where the source holds videos."""
    env = make(distractors="image", place="side", source=painted_clips(tmp_path, 5))
    shown = colours(env, 8, 3)
    assert (shown == shown[:, :1]).all() and len(np.unique(shown[:, 0, 0])) > 2
    env.close()


def test_a_video_plays_frame_by_frame_and_begins_again_where_it_ends(tmp_path):
    env = make(distractors="video", place="side", source=painted_clips(tmp_path, 5))
    shown = colours(env, 8, 12)
    assert (shown[..., 0] == shown[:, :1, 0]).all() and len(np.unique(shown[:, 0, 0])) > 2
    frames = shown[..., 2].astype(int) // 40
    assert ((frames[:, 1:] - frames[:, :-1]) % 5 == 1).all() and len(np.unique(frames[:, 0])) > 2
    env.close()


def test_evaluation_shows_held_out_clips_only(tmp_path):
    source, seen = painted_clips(tmp_path, 1), {}
    for evaluation in (False, True):
        env = make(distractors="image", place="side", source=source, evaluation=evaluation)
        resets = [env.reset(seed=0 if number == 0 else None) for number in range(40)]
        seen[evaluation] = {int(observation[0, 0, -1]) for observation, _ in resets}
        numbers = {int(info["factors"]["clip"]) for _, info in resets}
        assert numbers == (set(range(6, 8)) if evaluation else set(range(6)))
        env.close()
    assert len(seen[True]) == 2 and len(seen[False]) == 6 and not seen[True] & seen[False]


def test_environments_that_are_open_at_once_show_their_own_pictures():
    options: list[dict[str, Any]] = [
        {"distractors": "video", "place": "sky_floor"}, {"task": "cheetah-run"}, {"quality": "paper", "image_size": 32}
    ]  # fmt: skip
    alone = []
    for chosen in options:
        env = make(**chosen)
        alone.append(played(env, 2))
        env.close()
    envs = [make(**chosen) for chosen in options]
    rows: list[list[Any]] = [[(*e.reset(seed=2),)] for e in envs]
    for step in range(4):
        for env, row in zip(envs, rows, strict=True):
            action = np.random.default_rng(9).uniform(-1, 1, (4, env.task.actions))[step]
            row.append(env.step(action.astype(np.float32)))
    envs[0].close()
    for row, expected in zip(rows, alone, strict=True):
        assert all(np.array_equal(one[0], other[0]) for one, other in zip(row, expected, strict=True))
    assert np.array_equal(envs[1]._observe(), alone[1][-1][0]), "closing one leaves the others intact"
    for env in envs[1:]:
        env.close()


@pytest.mark.parametrize("frames", [2, 3])
def test_frames_are_stacked_the_oldest_first(frames):
    """The first one is repeated when an episode begins, and nothing is left of the episode before."""
    env, single = make(frame_stack=frames, distractors="video", render_mode="rgb_array"), make(distractors="video")
    for seed in (1, None):
        stacked, plain = played(env, seed), played(single, seed)
        for step, (observation, reward, factors) in enumerate(stacked):
            expected = [plain[max(0, step - back)][0] for back in range(frames - 1, -1, -1)]
            assert np.array_equal(observation, np.concatenate(expected)) and reward == plain[step][1]
            assert all(np.array_equal(factors[name], plain[step][2][name]) for name in factors)
        assert env.observation_space.contains(stacked[-1][0]) and stacked[-1][0].shape[0] == 3 * frames
        assert np.array_equal(env.render(), plain[-1][0].transpose(1, 2, 0)), "the newest one is rendered"
    env.close()
    single.close()


def test_stacked_observations_are_not_written_over():
    env = make(frame_stack=2)
    first, *_ = env.reset(seed=0)
    kept = first.copy()
    played(env, None)
    assert np.array_equal(first, kept)
    env.close()


def test_the_task_that_an_id_decides_is_not_given_twice():
    with pytest.raises(
        UserError, match=r"task=cheetah-run: the task is walker-run; leave it out, or take repdib/Contr"
    ):
        make(task="cheetah-run", world="walker-run")
    env = make(world="cheetah-run")
    assert env.task.name == "cheetah-run"
    env.close()
    env = make()
    assert env.task.name == "walker-walk"
    env.close()


def test_render_shows_the_observation():
    env = make(render_mode="rgb_array", distractors="video")
    observation = played(env, 0)[-1][0]
    assert np.array_equal(env.render(), observation.transpose(1, 2, 0))
    env.close()


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"task": "walker-wlk"}, r"did you mean 'walker-walk'\?"),
        ({"image_size": 8}, r"image_size=8: must be from 16 to 512"),
        ({"image_size": 0, "distractors": "video"}, r"image_size=0: must be from 16 to 512"),
        ({"image_size": 1000}, r"image_size=1000: must be from 16 to 512"),
        ({"quality": "papr"}, r"quality=papr: unknown, did you mean 'paper'\?"),
        ({"distractors": "vdeo"}, r"distractors=vdeo: unknown, did you mean 'video'\? \(choices: image, none, video\)"),
        ({"place": "skyfloor"}, r"place=skyfloor: unknown, did you mean 'sky_floor'\? \(choices: side, sky, "),
        ({"distractors": "video", "source": "proceduraal"}, r"'proceduraal' is neither built in nor a folder, did you"),
        ({"task": "humanoid-walk", "distractors": "image"}, r"place=sky: nothing of the sky is seen in humanoid-walk"),
        ({"action_repeat": 0}, r"action_repeat=0: must be at least 1"),
        ({"frame_stack": 0}, r"frame_stack=0: must be at least 1"),
        ({"task": ""}, r"task : unknown, choices: "),
        ({"render_mode": "human"}, r"render_mode=human: must be rgb_array or None"),
    ],
)
def test_bad_input_is_one_line_with_the_nearest_choice(options, said):
    with pytest.raises(UserError, match=said) as caught:
        make(**options)
    assert "\n" not in str(caught.value)
