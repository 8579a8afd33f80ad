"""Observations as an encoder takes them, whatever order, type or stacking the environment has."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.spaces import Box, Dict, Discrete, Space
from gymnasium.utils.env_checker import check_env

from repdib_lightning.errors import UserError
from repdib_lightning.export.gymnasium_wrapper import PrepareObservation
from repdib_lightning.records import ArraySpec, DataSpec

FIRST, LAST = Box(0, 255, (3, 8, 10), np.uint8), Box(0, 255, (8, 10, 3), np.uint8)
STACKED = DataSpec({"front": ArraySpec((6, 8, 10))}, frame_stack=2)


class Recorded(gymnasium.Env[Any, Any]):
    """Random observations, kept as they were given; bare ones always in the same array."""

    def __init__(self, space: Space[Any]) -> None:
        self.observation_space, self.action_space = space, Discrete(2)
        self.given: list[Any] = []
        self._canvas = None if isinstance(space, Dict) else np.zeros(space.shape, space.dtype)

    def _draw(self) -> Any:
        drawn = self.observation_space.sample()
        self.given.append(drawn)
        if self._canvas is None:
            return drawn
        self._canvas[...] = drawn
        return self._canvas

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        if seed is not None:
            self.observation_space.seed(seed)
        return self._draw(), {}

    def step(self, action):
        return self._draw(), 0.0, False, False, {}


@pytest.mark.parametrize(("space", "turn"), [(FIRST, (0, 1, 2)), (LAST, (2, 0, 1))])
def test_frames_are_stacked_oldest_first_and_the_first_is_repeated(space, turn):
    env = Recorded(space)
    wrapped = PrepareObservation(env, STACKED)
    seen = [wrapped.reset(seed=0)[0], wrapped.step(0)[0], wrapped.step(0)[0]]
    a, b, c = (frame.transpose(turn) for frame in env.given)
    for found, wanted in zip(seen, ([a, a], [a, b], [b, c]), strict=True):
        np.testing.assert_array_equal(found["front"], np.concatenate(wanted))
        assert wrapped.observation_space.contains(found)
    seen = wrapped.reset()[0]["front"]
    np.testing.assert_array_equal(seen, np.concatenate([env.given[-1].transpose(turn)] * 2))


@pytest.mark.parametrize(("space", "turn"), [(FIRST, (0, 1, 2)), (LAST, (2, 0, 1))])
def test_an_observation_stays_as_it_was_when_the_environment_draws_again(space, turn):
    env = Recorded(space)
    wrapped = PrepareObservation(env, DataSpec({"front": ArraySpec((3, 8, 10))}))
    first = wrapped.reset(seed=0)[0]["front"]
    wrapped.step(0)
    np.testing.assert_array_equal(first, env.given[0].transpose(turn))


def test_stacks_of_the_environment_are_taken_as_they_are():
    env = Recorded(Box(0, 255, (8, 10, 6), np.uint8))
    wrapped = PrepareObservation(env, STACKED)
    wrapped.reset(seed=0)
    seen = wrapped.step(0)[0]["front"]
    np.testing.assert_array_equal(seen, env.given[1].transpose(2, 0, 1))


def test_pictures_and_sensors_are_taken_by_name_and_others_left_out():
    spec = DataSpec({"touch": ArraySpec((8,), "float32"), "front": ArraySpec((6, 8, 10))}, frame_stack=2)
    env = Recorded(Dict({"front": LAST, "other": FIRST, "touch": Box(-1, 1, (4,), np.float64)}))
    wrapped = PrepareObservation(env, spec)
    wrapped.reset(seed=0)
    seen = wrapped.step(0)[0]
    assert set(seen) == set(wrapped.observation_space.spaces) == {"touch", "front"}
    np.testing.assert_allclose(seen["touch"], np.concatenate([g["touch"] for g in env.given]), rtol=1e-6)
    np.testing.assert_array_equal(seen["front"], np.concatenate([g["front"].transpose(2, 0, 1) for g in env.given]))
    assert seen["touch"].dtype == np.float32 and seen["front"].dtype == np.uint8


@pytest.mark.filterwarnings("ignore::UserWarning:gymnasium")
@pytest.mark.parametrize("space", [LAST, Dict({"front": FIRST, "top": FIRST})])
def test_the_prepared_environment_is_a_valid_one(space):
    wrapped = PrepareObservation(Recorded(space), STACKED)
    assert wrapped.observation_space == Dict({"front": Box(0, 255, (6, 8, 10), np.uint8)})
    check_env(wrapped, skip_render_check=True)


@pytest.mark.parametrize(
    ("space", "message"),
    [
        (Box(0, 255, (9, 9, 3), np.uint8), r"'front' has shape \(9, 9, 3\), the encoder takes frames of \(3, 8, 10\)"),
        (Box(0, 1, (3, 8, 10), np.float32), r"'front' is float32, the encoder takes uint8"),
        (Dict({"frnt": FIRST}), r"no observation 'front', did you mean 'frnt'\?"),
        (Discrete(5), r"'front' is int64, the encoder takes uint8"),
    ],
)
def test_what_does_not_fit_is_refused_before_the_first_reset(space, message):
    with pytest.raises(UserError, match=message):
        PrepareObservation(Recorded(space) if not isinstance(space, Discrete) else Tabular(), STACKED)


class Tabular(gymnasium.Env[Any, Any]):
    observation_space, action_space = Discrete(5), Discrete(2)
