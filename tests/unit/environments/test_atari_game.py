"""One game: gymnasium's own preprocessing frame by frame, chance by seeds of its own, and where games end."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from repdib_lightning.environments.atari_game import AtariGame
from repdib_lightning.errors import UserError

pytest.importorskip("ale_py")
pytest.importorskip("cv2")


class Always:
    """A generator that always draws the same number."""

    def __init__(self, number: int) -> None:
        self.number = number

    def integers(self, *_: int) -> int:
        return self.number


def made(game: str = "breakout", **changed: Any) -> AtariGame:
    options = {"image_size": 84, "frame_skip": 4, "sticky": 0.0, "noop_max": 30, "max_frames": 108_000}
    return AtariGame(game, **(options | changed))


def begun(game: AtariGame, noops: int = 0, sticking: int = 0) -> AtariGame:
    game.reset(np.random.default_rng(noops), np.random.default_rng(sticking))
    return game


@pytest.mark.parametrize(("name", "skip"), [("Breakout", 4), ("Seaquest", 4), ("Pong", 1), ("Qbert", 3)])
def test_pictures_and_rewards_are_those_of_gymnasiums_preprocessing(name, skip):
    """Seaquest's sprites flicker, so that pooling shows."""
    import ale_py
    import gymnasium
    from gymnasium.wrappers import AtariPreprocessing

    gymnasium.register_envs(ale_py)
    plain = gymnasium.make(f"ALE/{name}-v5", frameskip=1, repeat_action_probability=0.0)
    theirs, ours = AtariPreprocessing(plain, noop_max=1, frame_skip=skip), made(name, frame_skip=skip)
    seen, _ = theirs.reset(seed=0)
    ours.reset(Always(1), np.random.default_rng(0))  # type: ignore[arg-type]
    assert np.array_equal(seen, ours.picture())
    random, rewarded = np.random.default_rng(0 if name == "Breakout" else 1), 0.0
    for _ in range(400):
        action = int(random.integers(ours.actions))
        seen, reward, over, truncated, _ = theirs.step(action)
        assert ours.step(action) == reward and (ours.over, ours.truncated) == (over, truncated)
        rewarded += abs(reward)
        if over:  # the last picture is that of the last frame; theirs may be older
            break
        assert np.array_equal(seen, ours.picture())
    assert rewarded > 0 and ours.picture().std() > 5


def memories(game: AtariGame, steps: int = 150) -> np.ndarray:
    seen = []
    for step in range(steps):
        game.step(2 + step // 9 % 2)
        seen.append(game.ram())
    return np.stack(seen)


def test_noops_and_sticky_actions_are_decided_by_their_own_seeds():
    sticky, plain = made("pong", sticky=0.25), made("pong")
    first = memories(begun(sticky, 5, 1))
    assert np.array_equal(first, memories(begun(sticky, 5, 1)))
    assert np.array_equal(first, memories(begun(made("pong", sticky=0.25), 5, 1)))
    assert not np.array_equal(first, memories(begun(sticky, 5, 2)))
    assert not np.array_equal(first, memories(begun(sticky, 6, 1)))
    assert np.array_equal(memories(begun(plain, 5, 1)), memories(begun(plain, 5, 2)))
    assert not np.array_equal(memories(begun(plain, 5, 1)), memories(begun(plain, 6, 1)))


@pytest.mark.parametrize("name", ["breakout", "pong", "qbert", "seaquest"])
def test_a_game_does_not_depend_on_those_that_were_played_before(name):
    """Seaquest's would: its console keeps something over a reset."""
    used = made(name)
    plans = [np.random.default_rng(seed).integers(used.actions, size=600) for seed in range(4)]

    def played(game: AtariGame, number: int) -> list[bytes]:
        begun(game, noops=number)
        seen = []
        for action in plans[number]:
            if game.over:
                break
            game.step(int(action))
            seen.append(game.ram().tobytes())
        return seen

    together = [played(used, number) for number in range(4)]
    for number in (1, 3):
        assert together[number] == played(made(name), number)


@pytest.mark.parametrize(("sticky", "least", "most"), [(0.0, 0.0, 0.0), (0.4, 0.25, 0.55)])
def test_a_tap_is_lost_as_often_as_actions_stick(sticky, least, most):
    """The paddle stays where the frame of the tap repeats the action before, which was none."""
    game, lost = begun(made(sticky=sticky, noop_max=0, frame_skip=1)), 0
    for tap in range(100):
        before = int(game.ram()[72])
        for action in (2 + tap % 2, 0, 0, 0, 0, 0):
            game.step(action)
        lost += int(game.ram()[72]) == before
    assert least <= lost / 100 <= most


def test_the_first_picture_is_of_one_frame_and_looking_changes_nothing():
    game, blind = begun(made("seaquest")), begun(made("seaquest"))
    screen = np.empty((210, 160), np.uint8)
    import cv2

    game._console.getScreenGrayscale(screen)
    assert np.array_equal(game.picture(), cv2.resize(screen, (84, 84), interpolation=cv2.INTER_AREA))
    for action in range(60):
        assert np.array_equal(game.picture(), game.picture())
        game.step(action % game.actions)
        blind.step(action % game.actions)
    assert np.array_equal(game.ram(), blind.ram()) and np.array_equal(game.picture(), blind.picture())


def test_a_game_is_cut_off_after_the_frames_allowed_and_not_called_over():
    game, frames = begun(made("pong", max_frames=403, noop_max=0)), 0
    while not (game.over or game.truncated):
        game.step(0)
        frames += 4
    assert (game.over, game.truncated, frames) == (False, True, 404)
    with pytest.raises(AssertionError, match="call reset"):
        game.step(0)
    begun(game)
    assert (game.over, game.truncated) == (False, False)


def test_a_game_that_is_lost_is_over():
    game, random = begun(made()), np.random.default_rng(0)
    lives = [game.lives()]
    while not (game.over or game.truncated):
        game.step(int(random.integers(4)))
        lives.append(game.lives())
    assert (game.over, game.truncated) == (True, False) and (lives[0], lives[-1]) == (5, 0)


@pytest.mark.parametrize(
    ("changed", "said"),
    [
        ({"image_size": 15}, "image_size=15: must be from 16 to 210"),
        ({"sticky": 1.0}, "sticky=1.0: must be at least 0 and below 1"),
        ({"frame_skip": 0}, "frame_skip=0: must be at least 1"),
        ({"noop_max": -1}, "noop_max=-1: must be at least 0"),
        ({"max_frames": 33}, "max_frames=33: must be at least 34, the no-ops and an action"),
    ],
)
def test_bad_arguments_are_one_line(changed, said):
    with pytest.raises(UserError) as told:
        made(**changed)
    assert str(told.value) == said


def test_an_action_that_is_not_there_is_refused():
    game = begun(made())
    for action in (-1, 4):
        with pytest.raises(UserError, match=rf"^action={action}: breakout has actions 0 to 3$"):
            game.step(action)
