"""Inverse dynamics against an explicit loop, and what its options change."""

from __future__ import annotations

import pytest
import torch
import torch.nn.functional as F

from repdib_lightning.errors import UserError
from repdib_lightning.objectives import InverseDynamics
from repdib_lightning.records import ActionSpec, ArraySpec, Batch, DataSpec


def spec(kind="discrete", horizon=4):
    return DataSpec({"x": ArraySpec((6,), "float32")}, ActionSpec(kind, 3), horizon=horizon)


def batch(kind="discrete", futures=2, horizon=4, count=5):
    generator = torch.Generator().manual_seed(0)
    offsets = torch.randint(1, horizon + 1, (count, 1 + futures), generator=generator)
    offsets[:, 0] = 0
    actions = torch.randint(0, 3, (count,), generator=generator)
    if kind == "continuous":
        actions = torch.randn(count, 3, generator=generator)
    observations = {"x": torch.randn(count, 1 + futures, 6, generator=generator)}
    return Batch(observations, actions, offsets, torch.arange(count))


def encode(observations):
    return observations["x"]


@pytest.mark.parametrize("feed_offset", [True, False])
def test_discrete_loss_equals_a_loop(feed_offset):
    torch.manual_seed(0)
    objective, data = InverseDynamics(6, spec(), hidden=16, feed_offset=feed_offset), batch()
    terms = []
    for i in range(5):
        for f in (1, 2):
            parts = [data.observations["x"][i, 0], data.observations["x"][i, f]]
            if feed_offset:
                parts.append(objective.offset_embedding.weight[data.offsets[i, f] - 1])
            logits = objective.predictor(torch.cat(parts))
            terms.append(-F.log_softmax(logits, 0)[data.actions[i]])
    output = objective(data, encode)
    torch.testing.assert_close(output.losses["inverse"], torch.stack(terms).mean())
    output.losses["inverse"].backward()
    assert all(p.grad is not None and p.grad.abs().sum() > 0 for p in objective.parameters())


@pytest.mark.parametrize("action_loss", ["squared", "cosine"])
def test_continuous_loss_equals_a_loop(action_loss):
    objective = InverseDynamics(6, spec("continuous"), hidden=16, feed_offset=False, action_loss=action_loss)
    data, terms = batch("continuous"), []
    for i in range(5):
        for f in (1, 2):
            predicted = objective.predictor(torch.cat([data.observations["x"][i, 0], data.observations["x"][i, f]]))
            wanted = data.actions[i]
            if action_loss == "cosine":
                predicted, wanted = predicted / predicted.norm(), wanted / wanted.norm()
            terms.append((predicted - wanted).square().mean())
    torch.testing.assert_close(objective(data, encode).losses["inverse"], torch.stack(terms).mean())


def test_all_frames_are_encoded_in_one_pass():
    calls = []

    def counting(observations):
        calls.append(observations["x"].shape)
        return observations["x"]

    InverseDynamics(6, spec())(batch(futures=3), counting)
    assert calls == [(5, 4, 6)]


def test_the_offset_changes_the_prediction_only_when_fed():
    before, after = torch.randn(2, 1, 6), torch.randn(2, 1, 6)
    ones, twos = torch.ones(2, 1, dtype=torch.int64), torch.full((2, 1), 2)
    for fed in (True, False):
        objective = InverseDynamics(6, spec(), feed_offset=fed)
        same = torch.equal(objective.predict(before, after, ones), objective.predict(before, after, twos))
        assert same is not fed


def test_one_step_has_no_offset_to_feed():
    assert InverseDynamics(6, spec(horizon=1)).offset_embedding is None


def test_it_learns_which_action_was_taken():
    """Latents that move by the action: the loss must fall far below chance within a second."""
    torch.manual_seed(0)
    objective = InverseDynamics(6, spec(horizon=1), hidden=32)
    optimiser = torch.optim.Adam(objective.parameters(), 1e-2)
    steps = torch.eye(6)[:3]
    for _ in range(150):
        actions, before = torch.randint(0, 3, (64,)), torch.randn(64, 6)
        frames = torch.stack([before, before + steps[actions]], 1)
        sample = Batch({"x": frames}, actions, torch.tensor([[0, 1]]).expand(64, 2), torch.arange(64))
        output = objective(sample, encode)
        optimiser.zero_grad()
        output.losses["inverse"].backward()
        optimiser.step()
    assert output.metrics["action_accuracy"] > 0.9


def test_bad_options():
    with pytest.raises(UserError, match="the data has none"):
        InverseDynamics(6, DataSpec({"x": ArraySpec((6,), "float32")}))
    with pytest.raises(UserError, match="did you mean 'cosine'"):
        InverseDynamics(6, spec("continuous"), action_loss="cosin")
    with pytest.raises(UserError, match="hidden must be at least 1"):
        InverseDynamics(6, spec(), hidden=0)
