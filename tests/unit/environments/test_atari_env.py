"""Atari in gymnasium: stacks, the same game amid any image, held-out images, ground truth, and what bad input says."""

from __future__ import annotations

import warnings
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from repdib_lightning.environments import register
from repdib_lightning.environments.atari_env import AtariEnv
from repdib_lightning.errors import UserError

pytest.importorskip("ale_py")
pytest.importorskip("cv2")


def played(env: AtariEnv, steps: int = 40, seed: int = 3) -> tuple[np.ndarray, np.ndarray]:
    """Observations and rewards of the same actions."""
    random, seen, rewards = np.random.default_rng(0), [env.reset(seed=seed)[0]], []
    for _ in range(steps):
        observation, reward, *_ = env.step(int(random.integers(4)))
        seen.append(observation)
        rewards.append(reward)
    return np.stack(seen), np.array(rewards)


def test_passes_the_checker_through_gymnasium_make():
    register()
    made = gymnasium.make("repdib/Atari-v0", game="Pong", side="right", frame_stack=2, render_mode="rgb_array")
    assert made.metadata["render_fps"] == 15 and made.action_space.n == 6
    assert made.observation_space.shape == (2, 84, 126)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warnings.filterwarnings("ignore", message=".*(image|channel|Box observation space).*")
        check_env(made.unwrapped)
    made.close()


@pytest.mark.parametrize("sticky", [0.0, 0.25])
def test_the_game_is_the_same_amid_any_image(sticky):
    plain, rewards = played(AtariEnv(sticky=sticky))
    rows, columns = slice(0, 84), slice(0, 84)
    for look, y, x in (
        ({"side": "right"}, rows, columns),
        ({"side": "left", "side_width": 10}, rows, slice(10, 94)),
        ({"side": "top", "evaluation": True}, slice(42, 126), columns),
        ({"side": "bottom", "distractor_seed": 4}, rows, columns),
    ):
        seen, same = played(AtariEnv(sticky=sticky, **look))
        assert np.array_equal(seen[:, :, y, x], plain) and np.array_equal(same, rewards)
        assert seen.shape != plain.shape
    other, _ = played(AtariEnv(sticky=sticky), seed=4)
    assert not np.array_equal(other, plain)


def test_stacks_hold_the_latest_frames_the_oldest_first():
    single, stacked = played(AtariEnv(side="right"))[0], played(AtariEnv(side="right", frame_stack=3))[0]
    frames = np.concatenate([single[:1], single[:1], single])[:, 0]
    for step, stack in enumerate(stacked):
        assert np.array_equal(stack, frames[step : step + 3])
    assert not np.array_equal(stacked[-1][0], stacked[-1][2])


def test_each_game_shows_another_image_and_evaluation_those_held_out():
    for evaluation, numbers in ((False, range(1000)), (True, range(1000, 1250))):
        env = AtariEnv(side="right", evaluation=evaluation, distractor_seed=2)
        shown = []
        for episode in range(6):
            seen, info = env.reset(seed=7 if episode == 0 else None)
            clip = int(info["factors"]["clip"])
            assert clip in numbers and np.array_equal(seen[0, :, 84:], env.side_image.image(clip))
            after, *_, info = env.step(1)
            assert np.array_equal(after[0, :, 84:], seen[0, :, 84:]) and info["factors"]["clip"] == clip
            shown.append(clip)
        assert len(set(shown)) > 3
        assert int(env.reset(seed=7)[1]["factors"]["clip"]) == shown[0]


def test_rewards_are_not_clipped_and_a_lost_life_ends_nothing():
    env = AtariEnv("qbert")
    env.reset(seed=0)
    random, rewards, lives, over = np.random.default_rng(0), [], [], False
    while not over:
        _, reward, over, truncated, _ = env.step(int(random.integers(2, 6)))
        rewards.append(reward)
        lives.append(env.game.lives())
        assert not truncated
    assert max(rewards) == 25.0 and sorted(set(lives)) == [0, 1, 2, 3, 4]


def test_factors_are_the_games_variables_and_the_images():
    env = AtariEnv(side="right")
    _, info = env.reset(seed=0)
    names = {"player_x", "ball_x", "ball_y", "lives", "bricks", "score"}
    assert set(env.factors()) == names | {"clip", "background"} and env.factors()["lives"] == 5
    assert env.factors()["player_x"] == env.ram()[72] and env.ram().shape == (128,)
    assert info["factors"]["score"].dtype == np.float32
    assert set(AtariEnv("tennis").factors()) == set()


def test_render_shows_what_the_agent_sees_last():
    env = AtariEnv(side="left", frame_stack=2, render_mode="rgb_array")
    seen, _ = env.reset(seed=0)
    seen = env.step(1)[0]
    picture = env.render()
    assert picture is not None and picture.shape == (84, 126, 3)
    assert (picture == seen[-1][..., None]).all()
    assert AtariEnv().render() is None


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"game": "Breakot"}, "game=Breakot: unknown, did you mean 'breakout'?"),
        ({"frame_stack": 0}, "frame_stack=0: must be at least 1"),
        ({"render_mode": "human"}, "render_mode=human: must be rgb_array or None"),
        ({"side": "up"}, "side=up: unknown, "),
        ({"side": "left", "side_width": 1}, "side_width=1: must be from 3 to 512"),
        ({"side": "left", "side_source": "nowhere"}, "side_source=nowhere: "),
        ({"max_frames": 10}, "max_frames=10: must be at least 34"),
    ],
)
def test_bad_arguments_are_one_line(options: dict[str, Any], said: str):
    with pytest.raises(UserError) as told:
        AtariEnv(**options)
    assert str(told.value).startswith(said) and "\n" not in str(told.value)
