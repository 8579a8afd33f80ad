"""A trained offline policy as a file: what is loaded acts as what was trained, and what is wrong is told."""

from __future__ import annotations

import json
import shutil

import numpy as np
import pytest
import torch
from offline_stores import VIEW, make_bundle, write_offline
from safetensors.torch import load_file, save_file

from repdib_lightning.errors import UserError
from repdib_lightning.rl.finetune_offline import _options
from repdib_lightning.rl.offline_training import OfflineTraining
from repdib_lightning.rl.policy_file import POLICY, load_policy

SMALL = {
    "env": "none", "env_options": None, "steps": 3, "seed": 0, "learning_rate": 1e-2, "batch_size": 8, "hidden": 12,
    "copies": 1, "shift": 1, "features": None, "channels": None, "strides": None, "frame_stack": None,
    "evaluate_every": 2, "episodes": 2, "film": 0, "device": "cpu",
}  # fmt: skip
FRESH = {"encoder": None, "features": 10, "channels": 3, "strides": [2], "frame_stack": 2}


def trained(folder, agent, data, **changes):
    folder.mkdir()
    training = OfflineTraining(_options(agent, {**SMALL, "data": data, **changes}))
    training.train(folder)
    training.finish(folder)
    return training


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    """Trainings in a folder of their own each: on a bundle, and end to end."""
    folder = tmp_path_factory.mktemp("policies")
    data = write_offline(folder / "data.h5")
    bundle = make_bundle(folder / "b" / "bundle", stack=2, quantised=True)
    return folder, {
        "td3bc": trained(folder / "td3bc", "td3bc", data, encoder=bundle.parent),
        "bc": trained(folder / "bc", "bc", data, encoder=bundle),
        "fresh": trained(folder / "fresh", "td3bc", data, **FRESH),
    }


@pytest.fixture
def run(runs, tmp_path):
    """A copy of a run on a bundle, to be damaged."""
    return shutil.copytree(runs[0] / "td3bc", tmp_path / "run")


def pictures(count=6):
    return np.random.default_rng(3).integers(0, 256, (count, 6, 8, 8), dtype=np.uint8)


@pytest.mark.parametrize("name", ["td3bc", "bc", "fresh"])
def test_what_is_loaded_acts_as_what_was_trained(runs, name):
    folder, made = runs
    policy = load_policy(folder / name)
    wanted = made[name].act({VIEW: pictures()})
    assert wanted.shape == (6, 2) and np.abs(wanted).max() < 1 and wanted.std(0).min() > 1e-3
    np.testing.assert_array_equal(policy(pictures()), wanted)
    np.testing.assert_array_equal(policy({VIEW: pictures()}), wanted)
    np.testing.assert_allclose(policy(pictures()[2]), wanted[2], rtol=1e-5, atol=1e-6)
    assert policy(pictures()[2]).shape == (2,) and policy.encoder.spec.frame_stack == 2


def test_a_policy_of_a_trained_encoder_moves_with_its_folder(runs, tmp_path):
    folder, made = runs
    shutil.copytree(folder / "fresh", tmp_path / "moved")
    np.testing.assert_array_equal(load_policy(tmp_path / "moved")(pictures()), made["fresh"].act({VIEW: pictures()}))
    shutil.rmtree(tmp_path / "moved" / "bundle")
    with pytest.raises(UserError, match=r"moved: its encoder, .*moved/bundle, is missing; put it back, or name one$"):
        load_policy(tmp_path / "moved")
    named = load_policy(tmp_path / "moved", folder / "fresh")
    np.testing.assert_array_equal(named(pictures()), made["fresh"].act({VIEW: pictures()}))


def test_a_bundle_that_is_named_takes_the_place_of_the_one_trained_on(runs, tmp_path):
    folder, made = runs
    other = make_bundle(tmp_path / "other", stack=2, quantised=True, seed=8)
    assert not np.allclose(load_policy(folder / "td3bc", other)(pictures()), made["td3bc"].act({VIEW: pictures()}))
    wide = make_bundle(tmp_path / "wide", features=24)
    with pytest.raises(UserError, match=r"wide: gives 24 features, the policy in .*td3bc takes 16$"):
        load_policy(folder / "td3bc", wide)
    with pytest.raises(UserError, match=r"nowhere: no such bundle"):
        load_policy(folder / "td3bc", tmp_path / "nowhere")


def test_a_bundle_that_has_gone_is_named(runs, run):
    tensors = load_file(run / POLICY)
    save_file(tensors, run / POLICY, {"policy": json.dumps({"agent": "bc", "encoder": "gone/bundle"})})
    with pytest.raises(UserError, match=r"^gone/bundle: no such bundle"):
        load_policy(run)


def test_folders_without_a_policy(tmp_path):
    for folder in (tmp_path, tmp_path / "nowhere"):
        with pytest.raises(UserError, match=rf"{folder.name}: holds no {POLICY}; name the folder of a finished run"):
            load_policy(folder)


def spoil(run, **changes):
    tensors = load_file(run / POLICY) | changes
    facts = {"policy": json.dumps({"agent": "td3bc", "encoder": "b"})}
    save_file({name: value for name, value in tensors.items() if value is not None}, run / POLICY, facts)


@pytest.mark.parametrize(
    "damage",
    [
        lambda run: (run / POLICY).write_bytes(b""),
        lambda run: (run / POLICY).write_bytes((run / POLICY).read_bytes()[:-40]),
        lambda run: (run / POLICY).write_bytes(b"not tensors" * 99),
        lambda run: save_file(load_file(run / POLICY), run / POLICY),
        lambda run: save_file(load_file(run / POLICY), run / POLICY, {"policy": "{"}),
        lambda run: save_file(load_file(run / POLICY), run / POLICY, {"policy": "[]"}),
        lambda run: save_file(load_file(run / POLICY), run / POLICY, {"policy": "{}"}),
        lambda run: spoil(run, **{"actor.network.2.weight": None}),
        lambda run: spoil(run, **{"actor.network.4.bias": None}),
        lambda run: spoil(run, **{"actor.network.6.weight": torch.zeros(1)}),
        lambda run: spoil(run, **{"actor.network.2.weight": torch.zeros(3, 4)}),
        lambda run: spoil(run, **{"actor.network.0.weight": torch.zeros(4)}),
        lambda run: spoil(run, **{"standardise.mean": torch.zeros(3)}),
        lambda run: spoil(run, **{"standardise.scale": None}),
    ],
)
def test_a_damaged_file_is_one_line(run, damage):
    damage(run)
    with pytest.raises(UserError) as caught:
        load_policy(run)
    assert str(caught.value).startswith(f"{run / POLICY}: not a policy of finetune td3bc or bc (")
    assert "\n" not in str(caught.value)
