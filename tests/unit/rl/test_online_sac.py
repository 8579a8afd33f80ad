"""SAC with an encoder that its critic trains: who owns it, what moves it, and when it stays as it is."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from online_snapshots import EPISODE, FRESH, HIDDEN, PIXELS, SCENE, STACK, TASK, make_run, play_toys, sac_options

from repdib_lightning.errors import UserError
from repdib_lightning.export import load_encoder
from repdib_lightning.export.frozen import FrozenEncoder
from repdib_lightning.rl.features import BottleneckFeatures
from repdib_lightning.rl.online_sac import SACTraining
from repdib_lightning.rl.online_sac_parts import BottleneckSAC


@pytest.fixture(autouse=True)
def toys(monkeypatch):
    play_toys(monkeypatch)


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    return make_run(tmp_path_factory.mktemp("explored") / "x")


def sac(encoder, **changes):
    return SACTraining(sac_options(encoder=encoder, **changes))


def pictures(count=5):
    random = np.random.default_rng(0)
    return {"pixels": random.integers(0, 256, (count, 3 * STACK, PIXELS, PIXELS), dtype=np.uint8)}


def tensors(count=8):
    return {name: torch.from_numpy(array) for name, array in pictures(count).items()}


def state(module):
    return {name: value.clone() for name, value in module.state_dict().items()}


def moved(module, before):
    return {name for name, value in module.state_dict().items() if not torch.equal(value, before[name])}


@pytest.mark.parametrize("frozen", [True, False])
def test_it_acts_as_stable_baselines_says(run, frozen):
    training = sac(run, frozen=frozen)
    seen = training.features(pictures()).numpy() if frozen else pictures()
    wanted, _ = training.agent.predict(seen, deterministic=True)
    np.testing.assert_allclose(training.act(pictures()), wanted, atol=1e-6)
    with torch.no_grad():
        features = training.features(pictures())
        actions = training.mean_actions(features)
        given = features if frozen else tensors(5)
        training.agent.policy.set_training_mode(False)
        both = torch.cat(training.agent.critic(given, actions), dim=1).amin(1)
        torch.testing.assert_close(training.values(features, actions), both)


@pytest.mark.parametrize("bottleneck", [True, False])
def test_one_encoder_is_the_critics_and_begins_as_given(run, bottleneck):
    training = sac(run, frozen=False, bottleneck=bottleneck)
    given = load_encoder(run / "snapshots" / "frames-000002000")
    wanted = given.encode(pictures()) if bottleneck else given.encoder(tensors(5))
    torch.testing.assert_close(training.features(pictures()), wanted)
    agent = training.agent
    owned = {id(p) for p in agent.critic.parameters()}
    assert not {id(p) for p in agent.actor.parameters()} & owned
    assert {id(p) for group in agent.actor.optimizer.param_groups for p in group["params"]} == {
        id(p) for p in agent.actor.parameters()
    }
    assert {id(p) for group in agent.critic.optimizer.param_groups for p in group["params"]} == owned
    target = agent.critic_target.features_extractor
    assert all(torch.equal(a, b) for a, b in zip(
        agent.critic.features_extractor.state_dict().values(), target.state_dict().values(), strict=True))  # fmt: skip


def test_the_actor_sees_the_critics_encoder_and_leaves_it_alone(run):
    agent = sac(run, frozen=False, shift=0).agent
    agent.policy.set_training_mode(True)
    before = state(agent.critic)
    actions, _ = agent.actor.action_log_prob(tensors())
    values = torch.cat(agent.critic(tensors(), actions), dim=1).amin(1)
    (-values.mean()).backward()
    assert not moved(agent.critic, before)  # nor do codebooks follow
    extractor = agent.critic.features_extractor
    assert all(parameter.grad is None for parameter in extractor.parameters())
    assert all(parameter.grad is not None for parameter in agent.actor.parameters() if parameter.ndim == 2)
    assert isinstance(extractor, BottleneckFeatures) and extractor.training
    with torch.no_grad():
        extractor.encoder.trunk[0].weight += 0.1
    changed, _ = agent.actor.get_action_dist_params(tensors())[:2]
    assert not torch.allclose(torch.tanh(changed), actions)


def test_the_critics_loss_trains_the_encoder_and_its_target_follows(run):
    agent = sac(run, frozen=False, shift=1, learning_rate=1e-2, tau=0.5).agent
    agent.learn(EPISODE + 2, callback=None, log_interval=None)
    before, target = state(agent.critic.features_extractor), state(agent.critic_target.features_extractor)
    agent.train(1, 8)
    changed = moved(agent.critic.features_extractor, before)
    assert {"encoder.trunk.0.weight"} <= changed and any("bottleneck" in name for name in changed)
    follows = moved(agent.critic_target.features_extractor, target)
    floats = {name for name in changed if agent.critic.features_extractor.state_dict()[name].is_floating_point()}
    assert floats <= follows


def test_codebooks_follow_once_an_update(run, monkeypatch):
    agent = sac(run, frozen=False).agent
    passes, forward = [], BottleneckFeatures.forward

    def counted(features, observations):
        passes.append(features.training)
        return forward(features, observations)

    monkeypatch.setattr(BottleneckFeatures, "forward", counted)
    agent.learn(EPISODE + 1, callback=None, log_interval=None)
    passes.clear()
    agent.train(1, 8)
    assert passes.count(True) == 1


def test_its_frames_and_files(run, tmp_path, monkeypatch):
    singles, encode = [], FrozenEncoder.encode

    def counted(encoder, observations):
        singles.append(np.ndim(observations["pixels"]) == 3)
        return encode(encoder, observations)

    monkeypatch.setattr(FrozenEncoder, "encode", counted)
    training = sac(run, update_every=7)  # which does not divide 60: it stops soon after
    training.train(tmp_path)
    training.finish(tmp_path)
    steps = training.agent.num_timesteps
    assert 3 * EPISODE <= steps < 3 * EPISODE + 7 and sum(singles) == steps + 1 + 3  # and the first of each episode
    assert {path.name.partition(".")[0] for path in tmp_path.iterdir()} == {
        "events", "finetune", "outcome", "policy", "progress", "values",
    }  # fmt: skip


@pytest.mark.parametrize("frozen", [True, False])
def test_its_policy_is_read_back(run, tmp_path, frozen):
    training = sac(run, frozen=frozen, learning_rate=1e-2)
    training.train(tmp_path)
    training.finish(tmp_path)
    agent = BottleneckSAC.load(tmp_path / "policy.zip", device="cpu")
    encoder = load_encoder(run / "snapshots" / "frames-000002000" if frozen else tmp_path / "bundle")
    seen = encoder.encode(pictures()).numpy() if frozen else pictures()
    np.testing.assert_allclose(agent.predict(seen, deterministic=True)[0], training.act(pictures()), atol=1e-5)
    torch.testing.assert_close(training.features(pictures()), encoder.encode(pictures()))


@pytest.mark.parametrize(("options", "said"), [
    ({"learning_rate": 1e30}, "train/.* is "),
    ({"value_limit": 1e-9}, "train/value is .* beyond --value_limit 1e-09"),
])  # fmt: skip
def test_of_an_agent_that_diverges_the_policy_of_before_is_kept(run, tmp_path, options, said):
    training = sac(run, **options)
    before = training.act(pictures())
    with pytest.raises(UserError, match=said):
        training.train(tmp_path)
    agent = BottleneckSAC.load(tmp_path / "policy.zip", device="cpu")
    seen = training.features(pictures()).numpy()
    np.testing.assert_allclose(agent.predict(seen, deterministic=True)[0], before, atol=1e-6)
    assert not (tmp_path / "outcome.json").exists()


def test_pictures_that_it_would_turn_are_refused(run):
    with pytest.raises(UserError, match=r"--frozen false: 'pixels' .* has more channels than pixels along a side"):
        sac(None, task=TASK, env_options=dict(SCENE), **{**FRESH, "frame_stack": 6})


def test_from_scratch(tmp_path):
    training = sac(None, task=TASK, env_options=dict(SCENE), **FRESH)
    before = state(training.parts[0])
    training.train(tmp_path)
    assert moved(training.parts[0], before) and training.width == 8 and training.hidden == HIDDEN
