"""Options of the online agents: what they stand for unless said, and what cannot be."""

from __future__ import annotations

from pathlib import Path

import pytest
from online_snapshots import ddpg_options, sac_options

from repdib_lightning.errors import UserError
from repdib_lightning.rl.online_options import check_online_options

RUN = Path("runs/x")


@pytest.mark.parametrize(("given", "frozen"), [({}, True), ({"frozen": False}, False), ({"frozen": True}, True)])
def test_a_given_encoder_is_frozen_unless_said(given, frozen):
    assert ddpg_options(encoder=RUN, **given).is_frozen is frozen


def test_a_fresh_encoder_is_trained():
    options = ddpg_options(task="walker-run")
    check_online_options(options)
    assert not options.is_frozen and options.fresh("features") == 256 and options.fresh("frame_stack") == 3


def test_returns_of_sac_are_as_long_as_its_buffer_can_have_them():
    assert sac_options(encoder=RUN).steps_of_returns == 3 == ddpg_options(encoder=RUN, frozen=False).steps_of_returns
    assert sac_options(encoder=RUN, frozen=False).steps_of_returns == 1 == sac_options(task="x-y").steps_of_returns
    assert sac_options(encoder=RUN, n_steps=5).steps_of_returns == 5
    with pytest.raises(UserError, match="--n_steps 2: Stable-Baselines3 keeps longer returns with --frozen true only"):
        check_online_options(sac_options(encoder=RUN, frozen=False, n_steps=2))


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ({"features": 8}, "--features: is of a fresh encoder, --encoder runs/x has its own; leave it out"),
        ({"strides": [2]}, "--strides: is of a fresh encoder"),
        ({"bottleneck_losses": 0.5}, "--bottleneck_losses is of an encoder that the agent trains; add --frozen false"),
        ({"shift": 2}, "--shift is of an encoder that the agent trains"),
        ({"frozen": False, "bottleneck": False, "bottleneck_losses": 1.0}, "mean nothing with --bottleneck false"),
        ({"bottleneck": False, "agent": "actor"}, "--agent actor: explored behind the bottleneck"),
        ({"agent": "frsh"}, "--agent frsh: unknown, did you mean 'fresh'? (choices: actor, both, fresh)"),
        ({"frames": 0}, "--frames must be at least 1, is 0"),
        ({"frames": 1050}, "--seed_frames 1050: must be below --frames 1050"),
        ({"seed_frames": -1}, "--seed_frames must be from 0 to 4294967295, is -1"),
        ({"seed": 2**32}, "--seed must be from 0 to"),
        ({"snapshot": -5}, "--snapshot must be from 0 to"),
        ({"film": -1}, "--film must be from 0"),
        ({"hidden": 0}, "--hidden must be at least 1"),
        ({"n_steps": 0}, "--n_steps must be at least 1"),
        ({"update_every": 0}, "--update_every must be at least 1"),
        ({"episodes": 0}, "--episodes must be at least 1"),
        ({"evaluate_every": -3}, "--evaluate_every must be at least 1, is -3"),
        ({"batch_size": 0}, "--batch_size must be at least 1"),
        ({"learning_rate": 0.0}, "--learning_rate must be above 0 and finite"),
        ({"learning_rate": float("nan")}, "--learning_rate must be above 0 and finite, is nan"),
        ({"value_limit": 0.0}, "--value_limit must be above 0 and finite"),
        ({"noise": -0.1}, "--noise must be finite and not negative"),
        ({"noise_clip": float("inf")}, "--noise_clip must be finite and not negative"),
        ({"frozen": False, "bottleneck_losses": -1.0}, "--bottleneck_losses must be finite and not negative"),
        ({"gamma": 1.5}, "--gamma must be in [0, 1], is 1.5"),
        ({"tau": 0.0}, "--tau must be above 0 and at most 1"),
        ({"device": "gpu"}, "--device gpu: there is no such device, did you mean 'cpu'?"),
    ],
)
def test_what_cannot_be_beside_an_encoder(given, said):
    with pytest.raises(UserError) as error:
        check_online_options(ddpg_options(encoder=RUN, **given))
    assert said in str(error.value)


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ({"snapshot": 4}, "--snapshot 4: is of a run of exploration; name it with --encoder"),
        ({"frozen": True}, "--frozen needs --encoder"),
        ({"bottleneck": False}, "--bottleneck: a fresh encoder has no bottleneck"),
        ({"bottleneck_losses": 0.5}, "--bottleneck_losses: a fresh encoder has no bottleneck"),
        ({"agent": "both"}, "--agent both: is one that explored; name its run with --encoder"),
        (
            {"task": ""},
            "--task: name one, choices: walker-stand, walker-walk, walker-run, walker-flip, quadruped-stand",
        ),
        ({"features": 0}, "--features must be at least 1, is 0"),
        ({"strides": []}, "--strides must be at least 1, is []"),
    ],
)
def test_what_cannot_be_from_scratch(given, said):
    with pytest.raises(UserError) as error:
        check_online_options(ddpg_options(**{"task": "walker-run", **given}))
    assert said in str(error.value)
    assert "\n" not in str(error.value)


def test_buffers_are_of_sac():
    with pytest.raises(UserError, match="--buffer_size must be at least 1, is 0"):
        check_online_options(sac_options(encoder=RUN, buffer_size=0))
