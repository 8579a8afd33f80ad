"""Where an offline agent is evaluated: what its data tell, what the user adds, and what does not go together."""

from __future__ import annotations

import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import gymnasium
import pytest
from offline_stores import register_quadrants

from repdib_lightning.errors import UserError
from repdib_lightning.records import ActionSpec, ArraySpec
from repdib_lightning.rl import offline_evaluation
from repdib_lightning.rl.offline_environment import evaluated_environment, recorded_options
from repdib_lightning.rl.offline_evaluation import open_copies

CONTROL = "repdib/Control-v0"
RECORDED = {
    "task": "walker-walk", "action_repeat": 4, "image_size": 24, "quality": "fast", "distractors": "image",
    "place": "sky", "source": "", "seed": 3, "samples": 10, "behaviour": "random", "policy": "",
}  # fmt: skip


def store(pixels=24, **attributes: Any) -> Any:
    observations = {"pixels": ArraySpec((3, pixels, pixels))}
    return SimpleNamespace(path=Path("data.h5"), attributes=attributes, observations=observations)


def control(**changes):
    return store(environment="control", configuration=json.dumps(RECORDED | changes))


def vd4rl(pixels=84):
    return store(pixels, environment="dm_control/walker_walk", policy="expert")


def test_a_recording_is_evaluated_as_it_was_made_amid_held_out_clips():
    name, options = evaluated_environment(control(), "", {})
    assert name == CONTROL
    assert options == {
        "task": "walker-walk", "action_repeat": 4, "image_size": 24, "quality": "fast", "distractors": "image",
        "place": "sky", "source": "", "distractor_seed": 3, "evaluation": True,
    }  # fmt: skip


@pytest.mark.parametrize("env", ["", CONTROL, "Control"])
def test_options_go_over_those_of_the_recording(env):
    _, options = evaluated_environment(control(), env, {"distractors": "video", "evaluation": False})
    assert options == recorded_options(control()) | {"distractors": "video", "evaluation": False}
    same = {"task": "walker_walk", "image_size": 24}
    assert evaluated_environment(control(), env, same)[1]["task"] == "walker_walk"


@pytest.mark.parametrize(
    ("option", "given", "recorded"),
    [
        ("action_repeat", 2, 4),
        ("task", "cheetah-run", "walker-walk"),
        ("image_size", 64, 24),
        ("distractor_seed", 4, 3),
    ],
)
@pytest.mark.parametrize("env", ["", "Control"])
def test_another_problem_than_the_recorded_one_is_refused(env, option, given, recorded):
    with pytest.raises(UserError) as caught:
        evaluated_environment(control(), env, {option: given})
    assert str(caught.value) == (
        f"--env_options.{option} {given}: data.h5 was recorded with {recorded}; leave it out, or collect other data"
    )


def test_imported_vd4rl_is_evaluated_as_it_was_recorded_there():
    name, options = evaluated_environment(vd4rl(), "", {})
    assert name == CONTROL and options == {
        "task": "walker_walk", "action_repeat": 2, "image_size": 84, "quality": "paper", "evaluation": True,
    }  # fmt: skip
    assert evaluated_environment(vd4rl(64), "", {})[1]["image_size"] == 64
    assert evaluated_environment(vd4rl(), "", {"task": "walker-walk", "quality": "fast"})[1]["quality"] == "fast"
    with pytest.raises(UserError, match=r"^--env_options.action_repeat 4: data.h5 was recorded with 2;"):
        evaluated_environment(vd4rl(), "", {"action_repeat": 4})


def test_published_sets_that_change_the_scene_need_a_name():
    data = store(environment="dm_control/walker_walk", vd4rl_set="main/walker_walk/expert/84px")
    assert evaluated_environment(data, "", {})[0] == CONTROL
    data.attributes["vd4rl_set"] = "distracting/walker_walk/expert/84px"
    with pytest.raises(UserError, match="does not tell in which environment it was recorded"):
        evaluated_environment(data, "", {})


def test_without_distractors_their_place_and_source_are_left_out():
    recorded = control(source="my clips", place="side")
    _, options = evaluated_environment(recorded, "", {"distractors": "none"})
    assert "place" not in options and "source" not in options
    assert evaluated_environment(recorded, "", {})[1]["source"] == "my clips"


@pytest.mark.parametrize(
    "attributes", [{}, {"environment": "control"}, {"environment": "robot_arm"}, {"environment": "my own"}]
)
def test_data_of_another_environment_need_a_name(attributes):
    with pytest.raises(UserError) as caught:
        evaluated_environment(store(**attributes), "", {})
    assert str(caught.value) == (
        "data.h5: does not tell in which environment it was recorded; name one with --env, or train without evaluation "
        "with --env none"
    )
    assert evaluated_environment(store(**attributes), "Pendulum-v1", {"g": 3}) == ("Pendulum-v1", {"g": 3})
    held_out = {"evaluation": True, "image_size": 20}
    assert evaluated_environment(store(**attributes), "Control", {"image_size": 20}) == ("Control", held_out)


def test_another_environment_than_the_recorded_one_takes_its_own_options():
    assert evaluated_environment(control(), "Pendulum-v1", {"g": 3}) == ("Pendulum-v1", {"g": 3})


def test_no_evaluation():
    for data in (control(), store()):
        assert evaluated_environment(data, "none", {}) is None
    with pytest.raises(UserError, match=r"^--env_options mean nothing with --env none; leave one of them out$"):
        evaluated_environment(control(), "none", {"distractors": "video"})


def test_copies_are_opened(monkeypatch):
    opened = open_copies(register_quadrants(), {}, 3, ActionSpec("continuous", 2))
    assert len({id(env.unwrapped) for env in opened}) == 3
    assert all(env.action_space.shape == (2,) for env in opened)


@pytest.mark.parametrize(
    ("name", "actions", "space"),
    [("quadrants", 6, r"Box\(-1.0, 1.0, \(2,\), float32\)"), ("CartPole-v1", 2, r"Discrete\(2\)")],
)
def test_other_actions_than_those_of_the_data_are_refused(monkeypatch, name, actions, space):
    name = register_quadrants() if name == "quadrants" else name
    closed = []
    monkeypatch.setattr(gymnasium.Wrapper, "close", lambda self: closed.append(self))
    wanted = rf"^--env {name}: its actions are {space}, those of the data are continuous, {actions} wide$"
    with pytest.raises(UserError, match=wanted):
        open_copies(name, {}, 3, ActionSpec("continuous", actions))
    assert len(closed) == 1


def test_where_a_later_copy_does_not_open_none_stays_open(monkeypatch):
    closed, opened = [], []
    monkeypatch.setattr(gymnasium.Wrapper, "close", lambda self: closed.append(self))

    def open_two(name, options):
        if len(opened) == 2:
            raise UserError("no more memory")
        opened.append(gymnasium.make(name))
        return opened[-1]

    monkeypatch.setattr(offline_evaluation, "open_environment", open_two)
    with pytest.raises(UserError, match="no more memory"):
        open_copies(register_quadrants(), {}, 3, ActionSpec("continuous", 2))
    assert len(opened) == 2 and closed == opened
