"""A trained Decision Transformer as a file: what is loaded acts as what was trained, and what is wrong is told."""

from __future__ import annotations

import json
import shutil

import numpy as np
import pytest
import torch
from safetensors import safe_open
from safetensors.torch import load_file, save_file
from small_choices import FRESH, VIEW, Choices, choices_bundle, options, record_choices

from repdib_lightning.errors import UserError
from repdib_lightning.export.gymnasium_wrapper import PrepareObservation
from repdib_lightning.rl.decision_transformer.policy import POLICY, load_decision_transformer
from repdib_lightning.rl.decision_transformer.training import DTTraining

KINDS = ("latents", "codes", "fresh")


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    """Trainings in a folder of their own each: on latents, on codes, and end to end."""
    folder, made = tmp_path_factory.mktemp("policies"), {}
    data, bundle = record_choices(folder / "d.h5", 20), choices_bundle(folder / "b" / "bundle", stack=2, quantised=True)
    for kind, chosen in zip(
        KINDS, ({"encoder": bundle}, {"encoder": bundle.parent, "codes": True}, FRESH), strict=True
    ):
        made[kind] = training = DTTraining(options(data, target_return=3.5, learning_rate=3e-2, **chosen))
        (folder / kind).mkdir()
        training.train(folder / kind)
        training.finish(folder / kind)
    return folder, made


def acted(play, episodes=3):
    """Actions of a play, on random pictures and rewards."""
    random, found = np.random.default_rng(0), []
    for step in range(9):
        pictures = random.integers(0, 256, (episodes, 2, 8, 8), dtype=np.uint8)
        rewards = None if step == 0 else random.random(episodes)
        found.append(play.act({VIEW: pictures}, rewards).tolist())
    return found


@pytest.mark.parametrize("kind", KINDS)
def test_what_is_loaded_acts_as_what_was_trained(runs, kind):
    folder, made = runs
    policy = load_decision_transformer(folder / kind)
    wanted = acted(made[kind].begin(3, 4))
    assert acted(policy.begin(episodes=3, seed=4)) == wanted and len({a for step in wanted for a in step}) == 3
    assert (policy.target_return, policy.temperature) == (3.5, 1.0) and not policy.network.training
    assert acted(policy.begin(episodes=3, seed=5)) != wanted
    greedy = acted(policy.begin(episodes=3, temperature=0.0))
    assert greedy == acted(policy.begin(episodes=3, temperature=0.0, seed=9))


def test_it_acts_in_ones_own_loop(runs):
    policy = load_decision_transformer(runs[0] / "latents")
    env = PrepareObservation(Choices(), policy.encoder.spec)
    seen, _ = env.reset(seed=0)
    play, ended = policy.begin(target_return=6.0), False
    action = play.act(seen)
    while not ended:
        assert action.shape == (1,)
        seen, reward, _, ended, _ = env.step(action[0])
        action = play.act(seen, reward)
    bare = policy.begin(target_return=6.0)
    assert bare.act(env.reset(seed=0)[0][VIEW]).tolist() == [env.unwrapped.taken[0]]


def test_one_of_a_trained_encoder_moves_with_its_folder(runs, tmp_path):
    folder, made = runs
    shutil.copytree(folder / "fresh", tmp_path / "moved")
    assert acted(load_decision_transformer(tmp_path / "moved").begin(episodes=3)) == acted(made["fresh"].begin(3, 0))
    shutil.rmtree(tmp_path / "moved" / "bundle")
    with pytest.raises(UserError, match=r"moved: its encoder, .*moved/bundle, is missing; put it back, or name one$"):
        load_decision_transformer(tmp_path / "moved")
    named = load_decision_transformer(tmp_path / "moved", folder / "fresh")
    assert acted(named.begin(episodes=3)) == acted(made["fresh"].begin(3, 0))


def test_a_bundle_of_another_width_is_refused(runs, tmp_path):
    other = choices_bundle(tmp_path / "wide", stack=2, features=4)
    with pytest.raises(UserError, match=r"wide: gives 4 features, the policy in .*latents takes 6 features$"):
        load_decision_transformer(runs[0] / "latents", other)
    with pytest.raises(UserError, match=r"gives 0 groups of 0 codes, the policy in .*codes takes 2 groups of 5 codes$"):
        load_decision_transformer(runs[0] / "codes", other)


def damaged(folder, change):
    path = folder / POLICY
    tensors = load_file(path)
    facts = {"policy": change(tensors)}
    path.unlink()
    save_file(tensors, path, {name: fact for name, fact in facts.items() if fact})


@pytest.mark.parametrize("how", ["cut", "other", "missing", "sizes"])
def test_damage_is_told(runs, tmp_path, how):
    run = shutil.copytree(runs[0] / "latents", tmp_path / "r")
    path = run / POLICY
    if how == "cut":
        path.write_bytes(path.read_bytes()[:-9])
    elif how == "other":
        damaged(run, lambda tensors: None)
    else:
        with safe_open(path, framework="pt") as file:
            facts = json.loads(file.metadata()["policy"])
        if how == "missing":
            damaged(run, lambda tensors: tensors.pop("head.weight") is not None and json.dumps(facts))
        else:
            facts["sizes"].pop("layers")
            damaged(run, lambda tensors: json.dumps(facts))
    with pytest.raises(UserError, match=rf"^{path}: not a policy of finetune dt \(") as caught:
        load_decision_transformer(run)
    assert "\n" not in str(caught.value)


def test_a_folder_without_a_policy_is_told(tmp_path):
    with pytest.raises(
        UserError, match=r": holds no policy.safetensors; name the folder of a finished run of finetune dt$"
    ):
        load_decision_transformer(tmp_path)


def test_what_plays_leaves_no_trace(runs):
    policy = load_decision_transformer(runs[0] / "codes")
    modules = (policy.network, policy.encoder)
    before = [value.clone() for module in modules for value in module.state_dict().values()]
    acted(policy.begin(episodes=3))
    after = [value for module in modules for value in module.state_dict().values()]
    assert all(torch.equal(one, other) for one, other in zip(before, after, strict=True))
