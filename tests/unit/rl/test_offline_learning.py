"""Agents learn: from data of random actions, where the best action is a linear function of what is shown."""

from __future__ import annotations

import json

import numpy as np
import pytest
from offline_stores import Quadrants, make_bundle, record_quadrants, register_quadrants

from repdib_lightning.rl.finetune_offline import finetune_bc, finetune_td3bc
from repdib_lightning.rl.policy_file import load_policy

SMALL = {"batch_size": 64, "hidden": 32, "learning_rate": 3e-3, "episodes": 10, "film": 0, "device": "cpu"}
IDLE = 0.155
"""Error of doing nothing."""


@pytest.fixture(scope="module")
def bundle(tmp_path_factory):
    return make_bundle(tmp_path_factory.mktemp("bundle") / "b", features=32)


def outcome(folder):
    return json.loads((folder / "outcome.json").read_text())["measures"]


def errors(policy, count=100):
    """Mean squared distance of a policy's actions to the best ones."""
    env = Quadrants()
    found = []
    for seed in range(count):
        seen, _ = env.reset(seed=10_000 + seed)
        found.append(np.square(policy(seen) - env.right()).mean())
    return float(np.mean(found))


def test_cloning_repeats_an_expert(tmp_path, bundle):
    data, reached = record_quadrants(tmp_path / "expert.h5", 200, skill=1.0)
    finetune_bc(data=data, encoder=bundle, env=register_quadrants(), steps=200, run=tmp_path / "r", **SMALL)
    found = outcome(tmp_path / "r")
    assert reached == pytest.approx(5.0, abs=1e-5) and found["return"] > 4.7  # doing nothing reaches 3.4
    assert found["clone_error"] < 0.02 and errors(load_policy(tmp_path / "r")) < 0.02
    assert errors(lambda seen: np.zeros(2)) == pytest.approx(IDLE, abs=0.02)


def test_values_make_more_of_random_actions_than_cloning(tmp_path, bundle):
    data, reached = record_quadrants(tmp_path / "random.h5", 300, skill=0.0)
    shared = {"data": data, "encoder": bundle, "env": register_quadrants(), **SMALL}
    finetune_bc(**shared, steps=100, run=tmp_path / "bc")
    finetune_td3bc(**shared, steps=300, gamma=0.5, n_steps=2, run=tmp_path / "td3bc")
    cloned, valued = (outcome(tmp_path / agent)["return"] for agent in ("bc", "td3bc"))
    assert reached < 0.5 and 3.0 < cloned < 3.8 and valued > 4.2
    assert errors(load_policy(tmp_path / "td3bc")) < IDLE / 2 < errors(load_policy(tmp_path / "bc"))


def test_end_to_end_learns_from_pictures(tmp_path):
    data, _ = record_quadrants(tmp_path / "expert.h5", 200, skill=1.0)
    fresh = {"features": 16, "channels": 4, "strides": [2], "frame_stack": 1, "shift": 0}
    finetune_bc(data=data, env=register_quadrants(), run=tmp_path / "r", steps=200, **SMALL, **fresh)
    assert outcome(tmp_path / "r")["return"] > 4.7 and errors(load_policy(tmp_path / "r")) < 0.02
