"""InfoNCE over time: what it is invariant to, that it learns, and bad options."""

from __future__ import annotations

import math

import pytest
import torch
from torch import nn

from repdib_lightning.errors import UserError
from repdib_lightning.objectives import OBJECTIVES, InfoNCE
from repdib_lightning.records import ArraySpec, Batch, DataSpec

SPEC = DataSpec({"x": ArraySpec((6,), "float32")}, None, horizon=1)


def batch(frames):
    count, length = frames.shape[:2]
    return Batch({"x": frames}, None, torch.ones(count, length, dtype=torch.int64), torch.arange(count))


def encode(observations):
    return observations["x"]


def test_the_order_of_the_batch_changes_nothing():
    torch.manual_seed(0)
    objective, frames = InfoNCE(6, SPEC).double(), torch.randn(5, 3, 6, dtype=torch.float64)
    first, second = (objective(batch(rows), encode) for rows in (frames, frames[[3, 0, 4, 2, 1]]))
    torch.testing.assert_close(first.losses["contrast"], second.losses["contrast"], rtol=1e-12, atol=1e-12)
    assert first.metrics["contrast_accuracy"] == second.metrics["contrast_accuracy"]


def test_equal_candidates_share_the_credit():
    """A collapsed representation scores by chance, and the order of equal candidates decides nothing."""
    torch.manual_seed(0)
    objective = InfoNCE(6, SPEC)
    collapsed = objective(batch(torch.ones(8, 2, 6)), encode).metrics
    assert collapsed["contrast_accuracy"] == 1 / 8
    assert abs(collapsed["contrast_nats"]) < 1e-6
    few = torch.randn(3, 6)[torch.randint(0, 3, (8, 2))]
    accuracies = [objective(batch(few[torch.randperm(8)]), encode).metrics["contrast_accuracy"] for _ in range(5)]
    for accuracy in accuracies:
        torch.testing.assert_close(accuracy, accuracies[0])


def test_the_direction_of_time_matters():
    torch.manual_seed(0)
    objective, frames = InfoNCE(6, SPEC), torch.randn(5, 2, 6)
    forth, back = (objective(batch(rows), encode).losses["contrast"] for rows in (frames, frames.flip(1)))
    assert not torch.isclose(forth, back, rtol=1e-3)


def test_scores_are_cosines_over_the_temperature():
    """However far apart latents are, no pair scores beyond 1 / temperature."""
    torch.manual_seed(0)
    frames = torch.randn(5, 2, 6) * 1e6
    loss = InfoNCE(6, SPEC, temperature=10.0)(batch(frames), encode).losses["contrast"]
    assert abs(loss - math.log(5)) <= 0.2
    assert InfoNCE(6, SPEC, temperature=0.01)(batch(frames), encode).losses["contrast"] > 2 * math.log(5)


def test_it_learns_which_future_is_whose():
    """A walk on a ring of 16 states, seen by 64 anchors: 8 candidates are possible at best."""
    torch.manual_seed(0)
    objective, encoder = InfoNCE(6, SPEC, projection=8), nn.Linear(16, 6)
    optimiser = torch.optim.Adam([*objective.parameters(), *encoder.parameters()], 1e-2)

    def walk():
        states = torch.randint(0, 16, (64,))
        rows = torch.stack([states, (states + 2 * torch.randint(0, 2, (64,)) - 1) % 16], 1)
        return objective(batch(torch.eye(16)[rows]), lambda observations: encoder(observations["x"]))

    before = walk().metrics
    for _ in range(300):
        optimiser.zero_grad()
        walk().losses["contrast"].backward()
        optimiser.step()
    after = walk().metrics
    assert before["contrast_nats"] < 0.1
    assert after["contrast_accuracy"] > 4 / 64
    assert math.log(8) - 0.5 < after["contrast_nats"] < math.log(8) + 0.2


def test_a_lone_candidate_is_refused_in_training_and_harmless_in_evaluation():
    objective, lone = InfoNCE(6, SPEC), batch(torch.randn(1, 2, 6))
    with pytest.raises(UserError, match="batch_size is 1: InfoNCE"):
        objective(lone, encode)
    output = objective.eval()(lone, encode)
    assert output.losses["contrast"] == 0 and output.metrics["contrast_nats"] == 0


def test_bad_options():
    with pytest.raises(UserError, match="projection must be at least 1, is 0"):
        InfoNCE(6, SPEC, projection=0)
    for temperature in (0.0, -0.1, math.inf, math.nan):
        with pytest.raises(UserError, match="temperature must be a positive number"):
            InfoNCE(6, SPEC, temperature=temperature)


def test_the_objectives_are_known_by_name():
    assert list(OBJECTIVES)[:3] == ["InverseDynamics", "DRIML", "InfoNCE"]
