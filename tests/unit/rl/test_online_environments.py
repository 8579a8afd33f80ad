"""Which task an online agent plays, and how it is shown to it."""

from __future__ import annotations

import os

import pytest

from repdib_lightning.environments.control_env import ControlEnv
from repdib_lightning.errors import UserError
from repdib_lightning.records import ArraySpec, DataSpec
from repdib_lightning.rl.online_environment import chosen_options, control_of, open_task

SPEC = DataSpec({"pixels": ArraySpec((9, 32, 48))}, frame_stack=3)
FACTS = {
    "task": "walker-stand", "frames": 100, "hidden": 4, "image_size": 32, "action_repeat": 4, "quality": "paper",
    "distractors": "video", "place": "side", "source": "", "distractor_seed": 3,
}  # fmt: skip
SEEN = {name: FACTS[name] for name in ("image_size", "action_repeat", "quality", "place", "source", "distractor_seed")}


@pytest.fixture(autouse=True)
def renderer(monkeypatch):
    monkeypatch.setenv("MUJOCO_GL", os.environ.get("MUJOCO_GL", "egl"))


def test_the_task_is_shown_as_in_pretraining():
    assert chosen_options("", {}, FACTS, SPEC) == {"task": "walker-stand", "distractors": "video", **SEEN}
    assert chosen_options("walker-run", {"quality": "fast"}, FACTS, SPEC) == {
        "task": "walker-run", "distractors": "video", **SEEN, "quality": "fast",
    }  # fmt: skip


def test_without_distractors_their_place_means_nothing():
    chosen = chosen_options("", {"distractors": "none"}, FACTS, SPEC)
    assert "place" not in chosen and "source" not in chosen and chosen["distractors"] == "none"


def test_of_a_bundle_alone_the_size_is_known_and_of_nothing_nothing():
    assert chosen_options("walker-run", {}, {}, SPEC) == {"task": "walker-run", "image_size": 32}
    assert chosen_options("walker-run", {"image_size": 20}, {}, None) == {"task": "walker-run", "image_size": 20}


@pytest.mark.parametrize(
    ("task", "options", "said"),
    [
        ("", {}, "--task: name one, such as walker-run"),
        ("walker-run", {"task": "x"}, "--env_options.task: name it with --task"),
        ("walker-run", {"evaluation": True}, "--env_options.evaluation: an agent learns amid some clips"),
        ("walker-run", {"frame_stack": 2}, "--env_options.frame_stack: frames are stacked as the encoder takes them"),
    ],
)
def test_what_is_not_for_the_user_to_choose(task, options, said):
    with pytest.raises(UserError, match=said):
        chosen_options(task, options, {}, None)


def test_learning_and_evaluation_are_amid_other_clips():
    chosen = {"task": "cartpole-balance", "image_size": 16, "action_repeat": 50, "distractors": "image"}
    for evaluation in (False, True):
        environment = open_task(chosen, evaluation=evaluation)
        control = control_of(environment)
        assert isinstance(control, ControlEnv) and control.evaluation is evaluation
        assert control.task.action_repeat == 50 and control.observation_space.shape == (3, 16, 16)
        environment.close()


@pytest.mark.parametrize(
    ("chosen", "said"),
    [
        ({"task": "walker-rn"}, "--task walker-rn: unknown, did you mean 'walker-run'?"),
        ({"task": "walker-rn"}, "jaco-reach_bottom_right"),
        ({"task": "walker-run", "image_size": 8}, "--env_options: image_size=8: must be from 16 to 512"),
        ({"task": "walker-run", "qualty": "fast"}, "--env_options.qualty: no such option, did you mean 'quality'?"),
        ({"task": "walker-run", "action_repeat": "x"}, "--env_options.action_repeat: expected int, got 'x'"),
    ],
)
def test_what_cannot_be_opened_is_one_line(chosen, said):
    with pytest.raises(UserError) as error:
        open_task(chosen, evaluation=False)
    assert said in str(error.value) and "\n" not in str(error.value) and "--env " not in str(error.value)
