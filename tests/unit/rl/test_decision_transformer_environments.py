"""Where a Decision Transformer is evaluated: as the data of Atari tell; discrete actions, as many as the data's."""

from __future__ import annotations

import json
from types import SimpleNamespace
from typing import Any

import gymnasium
import pytest
from offline_stores import register_quadrants
from small_choices import register_choices

from repdib_lightning.errors import UserError
from repdib_lightning.records import ActionSpec, ArraySpec
from repdib_lightning.rl.offline_environment import ATARI, evaluated_environment
from repdib_lightning.rl.offline_evaluation import open_copies

RECORDED = {
    "game": "breakout", "frame_skip": 4, "sticky": 0.25, "image_size": 84, "side": "right", "side_width": 42,
    "side_source": "", "seed": 5, "noop_max": 30, "max_frames": 2000, "transitions": 1000, "behaviour": "mixed",
}  # fmt: skip


def store(configuration: Any = RECORDED, environment: str = "atari") -> Any:
    attributes = {"environment": environment, "configuration": json.dumps(configuration)}
    return SimpleNamespace(path="data.h5", attributes=attributes, observations={"frame": ArraySpec((1, 84, 126))})


@pytest.mark.parametrize("env", ["", ATARI, "Atari"])
def test_atari_is_evaluated_as_it_was_recorded_amid_held_out_images(env):
    name, options = evaluated_environment(store(), env, {"sticky": 0.0})
    kept = {name: RECORDED[name] for name in RECORDED if name not in ("seed", "transitions", "behaviour")}
    assert (name, options) == (ATARI, {**kept, "sticky": 0.0, "distractor_seed": 5, "evaluation": True})


def test_what_the_data_do_not_tell_is_left_to_the_environment():
    name, options = evaluated_environment(store({"game": "pong", "frame_skip": 4}), "", {})
    assert (name, options) == (ATARI, {"game": "pong", "frame_skip": 4, "evaluation": True})


@pytest.mark.parametrize(
    ("option", "given"),
    [
        ("game", "pong"),
        ("frame_skip", 3),
        ("image_size", 64),
        ("side", "left"),
        ("side_width", 20),
        ("distractor_seed", 6),
    ],
)
def test_another_problem_than_the_recorded_one_is_refused(option, given):
    recorded = RECORDED["seed" if option == "distractor_seed" else option]
    with pytest.raises(UserError) as caught:
        evaluated_environment(store(), "", {option: given})
    told = f"--env_options.{option} {given}: data.h5 was recorded with {recorded}; leave it out, or collect other data"
    assert str(caught.value) == told
    assert evaluated_environment(store(), "", {"game": "Breakout"})[1]["game"] == "Breakout"


def test_other_environments_take_their_own_options():
    assert evaluated_environment(store(), "CartPole-v1", {}) == ("CartPole-v1", {})
    assert evaluated_environment(store(), "none", {}) is None
    held_out = evaluated_environment(store(environment="my own"), "Atari", {"game": "pong"})
    assert held_out == ("Atari", {"game": "pong", "evaluation": True})


def test_copies_with_discrete_actions_are_opened():
    opened = open_copies(register_choices(), {}, 3, ActionSpec("discrete", 3))
    assert len({id(env.unwrapped) for env in opened}) == 3


@pytest.mark.parametrize(
    ("name", "actions", "told"),
    [
        ("choices", 4, "has 3 actions, the data have 4 discrete ones"),
        ("quadrants", 4, "has no discrete actions but Box(-1.0, 1.0, (2,), float32), the data have 4 discrete ones"),
    ],
)
def test_other_actions_than_those_of_the_data_are_refused(monkeypatch, name, actions, told):
    name = register_choices() if name == "choices" else register_quadrants()
    closed = []
    monkeypatch.setattr(gymnasium.Wrapper, "close", lambda self: closed.append(self))
    with pytest.raises(UserError) as caught:
        open_copies(name, {}, 3, ActionSpec("discrete", actions))
    assert str(caught.value) == f"--env {name}: {told}" and len(closed) == 1
