"""What updates of DQN move, what follows them, and what they leave alone."""

from __future__ import annotations

import shutil

import numpy as np
import pytest
import torch
from small_trainings import WIDTH, copied, make_bundle, moved, pictures, quantiser, training
from stable_baselines3.common.save_util import load_from_zip_file

from repdib_lightning.bottlenecks import Identity
from repdib_lightning.export import load_encoder
from repdib_lightning.export.frozen import FrozenEncoder
from repdib_lightning.rl.dqn import BottleneckDQN


@pytest.fixture
def bundle(tmp_path):
    return make_bundle(tmp_path / "b")


def learn_one_update(run):
    """Random steps until the first update, and that one."""
    return run.agent.learn(run.options.learning_starts + 1)


@pytest.mark.parametrize("bottleneck", [None, Identity(WIDTH), quantiser(codebook="gradient")])
def test_one_update_moves_encoder_bottleneck_and_head(tmp_path, bottleneck):
    run = training(make_bundle(tmp_path / "b", bottleneck), batch_size=32)
    before = copied(run.agent.q_net)
    learn_one_update(run)
    changed = moved(run.agent.q_net, before)
    assert {name for name, _ in run.agent.q_net.named_parameters()} <= changed
    if bottleneck is None:
        book = "features_extractor.bottleneck.quantiser.book"
        assert {f"{book}.vectors", f"{book}.sums", f"{book}.sizes"} <= changed


def test_before_the_first_update_nothing_moves(bundle):
    run = training(bundle)
    before = copied(run.agent.policy)
    run.agent.learn(run.options.learning_starts)
    # Followers of what stands still: equal up to the rounding of (1 - tau) x + tau x.
    for name, value in run.agent.policy.state_dict().items():
        torch.testing.assert_close(value, before[name], msg=name)
    assert moved(run.agent.q_net, copied(training(bundle).agent.q_net)) == set()


def test_the_target_follows_in_parameters_and_running_codebooks(bundle, monkeypatch):
    run = training(bundle)
    online, target, tau = run.agent.q_net, run.agent.q_net_target, run.options.tau
    floats = [name for name, value in online.state_dict().items() if value.is_floating_point() and value.numel()]
    expected, start = copied(target), copied(online)
    followed = BottleneckDQN._on_step
    steps = 0

    def checked(agent):
        nonlocal steps
        for name in floats:
            expected[name] = (1 - tau) * expected[name] + tau * online.state_dict()[name]
        followed(agent)
        steps += 1
        for name in floats:
            torch.testing.assert_close(target.state_dict()[name], expected[name], msg=name)

    monkeypatch.setattr(BottleneckDQN, "_on_step", checked)
    run.agent.learn(20)
    assert steps == 20
    book = "features_extractor.bottleneck.quantiser.book"
    for name in (f"{book}.vectors", f"{book}.sizes", f"{book}.sums", "q_net.0.weight"):
        assert (online.state_dict()[name] - start[name]).abs().max() > 1e-3, name
        assert (target.state_dict()[name] - start[name]).abs().max() > 1e-4, name
        assert not torch.equal(target.state_dict()[name], online.state_dict()[name]), name


def test_the_target_is_never_in_training_mode_and_acting_changes_nothing(bundle):
    run = training(bundle)
    run.agent.learn(12)
    assert run.agent.q_net.training  # SB3 leaves it so after an update; asking for actions must end it
    before = copied(run.agent.policy)
    first = run.evaluation.run(run.act)
    assert first == run.evaluation.run(run.act)
    assert moved(run.agent.policy, before) == set()
    assert not any(module.training for module in run.agent.q_net_target.modules())


def test_frozen_learns_from_latents_encodes_each_frame_once_and_leaves_the_encoder(bundle, monkeypatch):
    run = training(bundle, frozen=True, n_steps=2)
    before, encode, encoded = copied(run.frozen), FrozenEncoder.encode, []
    monkeypatch.setattr(FrozenEncoder, "encode", lambda self, given: encoded.append(encode(self, given)) or encoded[-1])
    head = copied(run.agent.q_net)
    run.agent.learn(30)
    assert len(encoded) == run.visits.visits.sum() >= 31
    assert moved(run.frozen, before) == set() and moved(run.agent.q_net, head) == set(head)
    stored = run.agent.replay_buffer.observations
    assert stored.shape[1:] == (1, WIDTH) and stored.dtype == np.float32
    known = {latent.numpy().tobytes() for latent in encoded}
    assert {row.tobytes() for row in stored[:30, 0]} <= known and len(known) > 1
    assert not list(run.agent.q_net.features_extractor.parameters())
    assert run.evaluation.run(run.act)["moves"] <= 12


def test_a_saved_policy_needs_no_bundle_and_goes_on_learning(bundle, tmp_path):
    run = training(bundle)
    run.agent.learn(12)
    run.agent.save(tmp_path / "policy.zip")
    shutil.rmtree(bundle)
    # The weights stand in it once, not again among the plain values.
    assert "_followed" not in load_from_zip_file(tmp_path / "policy.zip")[0]
    loaded = BottleneckDQN.load(tmp_path / "policy.zip", env=run.environment, device="cpu")
    assert moved(loaded.policy, copied(run.agent.policy)) == set()
    given = {"picture": pictures(40).numpy()}
    actions = [agent.predict(given, deterministic=True)[0] for agent in (run.agent, loaded)]
    np.testing.assert_array_equal(*actions)
    loaded.set_logger(run.agent.logger)
    before = copied(loaded.q_net_target)
    loaded.learn(10)
    assert "features_extractor.bottleneck.quantiser.book.vectors" in moved(loaded.q_net_target, before)


def test_the_best_encoder_is_the_bundle_that_is_written(bundle, tmp_path, monkeypatch):
    run = training(bundle, evaluate_every=10)
    # An agent on a GPU goes on acting with the encoder that is saved, so it must stay where it is.
    monkeypatch.setattr(torch.nn.Module, "cpu", lambda self: pytest.fail("moves the agent's encoder off its device"))
    folder = tmp_path / "run"
    folder.mkdir()
    run.train(folder)
    outcome = run.finish(folder)
    best = BottleneckDQN.load(folder / "policy.zip", device="cpu")
    given = pictures(20)
    with torch.no_grad():
        best.policy.set_training_mode(False)
        latents = best.q_net.extract_features({"picture": given}, best.q_net.features_extractor)
    assert torch.equal(load_encoder(folder / "bundle").encode(given), latents)
    scores = [(row["eval/success"], row["eval/return"]) for row in run.progress.rows]
    assert (outcome["measures"]["success"], outcome["measures"]["return"]) == max(scores)


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU")
@pytest.mark.parametrize("frozen", [False, True])
def test_a_training_on_a_gpu(bundle, tmp_path, frozen):
    run = training(bundle, device="cuda", frozen=frozen, evaluate_every=20)
    run.train(tmp_path)
    assert run.agent.device.type == "cuda" and 0 <= run.finish(tmp_path)["measures"]["success"] <= 1
