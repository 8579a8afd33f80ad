"""DRIML: its critic, what actions add, and bad options. The loss itself is checked among the parity tests."""

from __future__ import annotations

import math

import pytest
import torch
from torch import nn

from repdib_lightning.errors import UserError
from repdib_lightning.objectives import DRIML
from repdib_lightning.records import ActionSpec, ArraySpec, Batch, DataSpec

STATES, MOVES = 16, torch.tensor([-1, 1])


def spec(kind="discrete", size=2, width=6):
    actions = None if kind is None else ActionSpec(kind, size)
    return DataSpec({"x": ArraySpec((width,), "float32")}, actions, horizon=2)


def batch(count=5, futures=1, seed=0):
    generator = torch.Generator().manual_seed(seed)
    frames = torch.randn(count, 1 + futures, 6, generator=generator)
    actions = torch.randint(0, 2, (count,), generator=generator)
    return Batch({"x": frames}, actions, torch.ones(count, 1 + futures, dtype=torch.int64), torch.arange(count))


def encode(observations):
    return observations["x"]


def walk(generator, count=64):
    """One step on a ring of states: the state says where the next one is but for the direction."""
    states = torch.randint(0, STATES, (count,), generator=generator)
    actions = torch.randint(0, 2, (count,), generator=generator)
    rows = torch.stack([states, (states + MOVES[actions]) % STATES], 1)
    frames = torch.eye(STATES)[rows]
    return Batch({"x": frames}, actions, torch.tensor([[0, 1]]).expand(count, 2), torch.arange(count))


def held_out_metrics(feed_action):
    torch.manual_seed(0)
    objective = DRIML(8, spec(width=STATES), hidden=32, action_features=8, feed_action=feed_action)
    encoder, generator = nn.Linear(STATES, 8), torch.Generator().manual_seed(1)
    optimiser = torch.optim.Adam([*objective.parameters(), *encoder.parameters()], 1e-2)
    for _ in range(300):
        loss = objective(walk(generator), lambda observations: encoder(observations["x"])).losses["contrast"]
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
    objective.eval()
    with torch.no_grad():
        runs = [objective(walk(generator), lambda rows: encoder(rows["x"])).metrics for _ in range(20)]
    return {name: sum(run[name].item() for run in runs) / len(runs) for name in runs[0]}


def test_the_action_adds_what_it_tells_of_the_next_state():
    """The state leaves two next states open; the action decides between them, which is worth log 2."""
    blind, told = held_out_metrics(False), held_out_metrics(True)
    assert blind["contrast_accuracy"] > 4 / 64
    assert told["contrast_accuracy"] > 8 / 64
    assert told["contrast_nats"] - blind["contrast_nats"] == pytest.approx(math.log(2), abs=0.1)
    assert blind["contrast_nats"] < math.log(STATES / 2)
    assert told["contrast_nats"] < math.log(STATES)


def test_scores_stay_within_the_clip_and_small_ones_as_they_are():
    objective = DRIML(6, spec(), hidden=16, clip=3.0)
    scores = objective.score(torch.tensor([-1e6, -1e-3, 0.0, 1e-3, 1e6]))
    torch.testing.assert_close(scores, torch.tensor([-3.0, -1e-3 / 4, 0.0, 1e-3 / 4, 3.0]))


def test_the_loss_of_the_worst_latents_is_bounded():
    objective, data = DRIML(6, spec(), hidden=16, clip=3.0), batch()
    data.observations["x"] *= 1e6
    assert objective(data, encode).losses["contrast"] <= 6.0 + math.log(5)


@pytest.mark.parametrize("futures", [1, 2])
def test_the_order_of_the_batch_changes_nothing(futures):
    torch.manual_seed(0)
    objective, data = DRIML(6, spec(), hidden=16).double(), batch(futures=futures)
    data.observations["x"] = data.observations["x"].double()
    order = torch.tensor([3, 0, 4, 2, 1])
    mixed = Batch({"x": data.observations["x"][order]}, data.actions[order], data.offsets, data.rows[order])
    first, second = (objective(sample, encode) for sample in (data, mixed))
    torch.testing.assert_close(first.losses["contrast"], second.losses["contrast"], rtol=1e-12, atol=1e-12)
    assert first.metrics["contrast_accuracy"] == second.metrics["contrast_accuracy"]


def test_futures_of_another_index_are_no_candidates():
    """The loss of two futures is the mean of the losses of each alone."""
    objective, data = DRIML(6, spec(), hidden=16), batch(futures=2)
    frames = data.observations["x"]
    alone = [
        objective(Batch({"x": frames[:, [0, f]]}, data.actions, data.offsets[:, :2], data.rows), encode) for f in (1, 2)
    ]
    expected = torch.stack([output.losses["contrast"] for output in alone]).mean()
    torch.testing.assert_close(objective(data, encode).losses["contrast"], expected)


def test_the_action_changes_the_loss_only_when_fed():
    for fed in (True, False):
        objective, data = DRIML(6, spec(), hidden=16, feed_action=fed), batch()
        first = objective(data, encode).losses["contrast"]
        data.actions = 1 - data.actions
        assert torch.equal(first, objective(data, encode).losses["contrast"]) is not fed
        assert objective.needs_actions is fed


def test_data_without_actions():
    objective, data = DRIML(6, spec(None), hidden=16, feed_action=False), batch()
    data.actions = None
    assert objective(data, encode).losses["contrast"].isfinite()


def test_all_frames_are_encoded_in_one_pass():
    calls = []

    def counting(observations):
        calls.append(observations["x"].shape)
        return observations["x"]

    DRIML(6, spec(), hidden=16)(batch(futures=3), counting)
    assert calls == [(5, 4, 6)]


def test_scores_are_computed_in_single_precision_under_autocast():
    torch.manual_seed(0)
    objective, data = DRIML(6, spec(), hidden=16), batch(count=40)
    with torch.autocast("cpu", dtype=torch.bfloat16):
        loss = objective(data, encode).losses["contrast"]
    assert loss.dtype == torch.float32
    torch.testing.assert_close(loss, objective(data, encode).losses["contrast"], rtol=1e-2, atol=1e-2)


def test_a_lone_candidate_is_refused_in_training_and_harmless_in_evaluation():
    objective, lone = DRIML(6, spec(), hidden=16), batch(count=1)
    with pytest.raises(UserError, match="batch_size is 1: DRIML"):
        objective(lone, encode)
    assert objective.eval()(lone, encode).losses["contrast"] == 0


def test_bad_options():
    with pytest.raises(UserError, match=r"the data has none.*set feed_action to false"):
        DRIML(6, spec(None))
    for name in ("hidden", "action_features"):
        with pytest.raises(UserError, match=f"{name} must be at least 1, is 0"):
            DRIML(6, spec(), **{name: 0})
    for clip in (0.0, -1.0, math.inf, math.nan):
        with pytest.raises(UserError, match="clip must be a positive number"):
            DRIML(6, spec(), clip=clip)
