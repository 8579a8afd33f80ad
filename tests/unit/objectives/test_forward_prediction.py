"""Forward prediction: what its number means, and that it does what multi-step inverse dynamics cannot."""

from __future__ import annotations

import pytest
import torch
from torch import nn

from repdib_lightning.objectives import ForwardPrediction, InverseDynamics, SeveralObjectives
from repdib_lightning.records import ActionSpec, ArraySpec, Batch, DataSpec

M = 4
SPEC = DataSpec({"x": ArraySpec((M,), "float32")}, ActionSpec("continuous", M), next_frame=True)


def encode(observations):
    return observations["x"]


def moves(count, noise=0.0):
    """Latents that move by the action, far from the origin."""
    before, actions = 50 + torch.randn(count, M), torch.randn(count, M)
    after = before + actions + noise * torch.randn(count, M)
    frames = torch.stack([before, after, after], 1)
    return Batch({"x": frames}, actions, torch.tensor([[0, 1, 1]]).expand(count, 3), torch.arange(count))


def test_it_starts_near_the_batch_mean_and_learns_what_the_action_does():
    torch.manual_seed(0)
    objective = ForwardPrediction(M, SPEC, hidden=32)
    with torch.no_grad():
        start = objective(moves(512), lambda observations: observations["x"] - 50).losses["forward"]
    assert start.item() == pytest.approx(1.0, abs=0.15)
    optimiser = torch.optim.Adam(objective.parameters(), 3e-3)
    for _ in range(300):
        output = objective(moves(128), lambda observations: observations["x"] - 50)
        optimiser.zero_grad()
        output.losses["forward"].backward()
        optimiser.step()
    assert output.losses["forward"] < 0.05 and output.metrics["forward_to_copying"] < 0.1


@pytest.mark.parametrize("factor", [1e-3, 1.0, 1e3])
def test_shrinking_all_latents_gains_nothing(factor):
    """The bare prediction of 0 costs the same whatever the scale: the error counts in units of the spread."""
    objective = ForwardPrediction(M, SPEC)
    for parameter in objective.parameters():
        nn.init.zeros_(parameter)
    loss = objective(moves(64), lambda observations: factor * observations["x"]).losses["forward"]
    assert loss.item() == pytest.approx(1.0, rel=1e-3)


def test_constant_latents_give_finite_losses_and_gradients():
    constant = torch.full((8, 3, M), 0.3, requires_grad=True)
    data = moves(8)
    output = ForwardPrediction(M, SPEC)(Batch({"x": constant}, data.actions, data.offsets, data.rows), encode)
    output.losses["forward"].backward()
    assert torch.isfinite(output.losses["forward"]) and torch.isfinite(constant.grad).all()


A, B, P, R, Q, U, V = range(7)
NEXT = torch.tensor([[P, Q], [R, Q], [U, V], [V, U]])
"""State and action -> next state. Inverse dynamics must tell P from R, whose actions lead the other way round, but not
A from B: P, Q and R alone say which action was taken there."""


def walks(count):
    state, action = torch.randint(0, 4, (count,)), torch.randint(0, 2, (count,))
    after = NEXT[state, action]
    frames = torch.eye(7)[torch.stack([state, after, after], 1)]
    return Batch({"x": frames}, action, torch.tensor([[0, 1, 1]]).expand(count, 3), torch.arange(count))


def trained_latents(parts):
    """Latents of the seven states after training, from an encoder to which A and B look nearly the same at first."""
    torch.manual_seed(0)
    spec = DataSpec({"x": ArraySpec((7,), "float32")}, ActionSpec("discrete", 2), next_frame=True)
    encoder = nn.Sequential(nn.Linear(7, 32), nn.ReLU(), nn.Linear(32, 4), nn.Tanh())
    with torch.no_grad():
        encoder[0].weight[:, B] = encoder[0].weight[:, A] + 0.01 * torch.randn(32)
    objective = SeveralObjectives(4, spec, parts=parts)
    optimiser = torch.optim.Adam([*encoder.parameters(), *objective.parameters()], 3e-3)
    for _ in range(400):
        losses = objective(walks(128), lambda observations: encoder(observations["x"])).losses
        optimiser.zero_grad()
        sum(losses.values()).backward()
        optimiser.step()
    assert losses["inverse"] < 0.05
    with torch.no_grad():
        return encoder(torch.eye(7))


def test_it_tells_apart_what_inverse_dynamics_merges():
    """A and B: the same to an inverse model, but what follows them is not."""
    parts = [lambda width, spec: InverseDynamics(width, spec, hidden=32)]
    alone = trained_latents(parts)
    both = trained_latents([*parts, lambda width, spec: ForwardPrediction(width, spec, hidden=32)])
    assert (alone[A] - alone[B]).norm() < 0.2 * (alone[P] - alone[R]).norm()
    assert (both[A] - both[B]).norm() > 0.5 * (both[P] - both[R]).norm()
