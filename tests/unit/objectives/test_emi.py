"""EMI: it finds the embedding in which actions add up, its terms mean what they say, and it moves no buffer."""

from __future__ import annotations

import math

import pytest
import torch
from torch import nn

from repdib_lightning.loss_weights import DEFAULT_LOSS_WEIGHTS
from repdib_lightning.objectives import EMI
from repdib_lightning.records import ActionSpec, ArraySpec, Batch, DataSpec

WIDE = 6
SPEC = DataSpec({"x": ArraySpec((WIDE,), "float32")}, ActionSpec("continuous", 2), next_frame=True)


def encode(observations):
    return observations["x"]


def moves(count=64):
    """The first two numbers move by the action, the others are noise."""
    frames, actions = torch.randn(count, 2, WIDE), torch.randn(count, 2)
    frames[:, 1, :2] = frames[:, 0, :2] + actions
    return Batch({"x": frames}, actions, torch.tensor([[0, 1]]).expand(count, 2), torch.arange(count))


def weighted(losses):
    return sum(DEFAULT_LOSS_WEIGHTS.get(name, 1.0) * value for name, value in losses.items())


def test_it_keeps_what_actions_move_and_drops_noise():
    torch.manual_seed(0)
    objective = EMI(WIDE, SPEC, dimensions=2, error_hidden=32)
    optimiser = torch.optim.Adam(objective.parameters(), 3e-3)
    for _ in range(600):
        output = objective(moves(256), encode)
        optimiser.zero_grad()
        weighted(output.losses).backward()
        optimiser.step()
    assert output.metrics["emi_explained"] > 0.9 and output.metrics["emi_recognised"] > 0.7
    assert output.losses["emi_information"] < 2 * 2 * math.log(2) - 0.5
    assert output.losses["emi_action_kl"] < 0.3 and output.losses["emi_error"] < 0.01
    weight = objective.state_embedding.weight.detach()
    assert weight[:, :2].norm() > 5 * weight[:, 2:].norm()


def test_the_terms_at_known_embeddings():
    objective, data = EMI(WIDE, SPEC, dimensions=2).eval(), moves(4096)
    with torch.no_grad():
        for parameter in objective.parameters():
            parameter.zero_()
        objective.state_embedding.weight[:, :2] = torch.eye(2)
        objective.action_embedding[0].weight[:4] = torch.cat([torch.eye(2), -torch.eye(2)])
        objective.action_embedding[2].weight[:, :4] = torch.cat([torch.eye(2), -torch.eye(2)], dim=1)
        output = objective(data, encode)
    assert output.losses["emi_dynamics"].item() == pytest.approx(0.0, abs=1e-10)
    assert output.losses["emi_error"].item() == 0.0
    assert output.losses["emi_information"].item() == pytest.approx(4 * math.log(2), rel=1e-6)
    assert output.losses["emi_action_kl"].item() == pytest.approx(0.0, abs=0.01)
    assert output.metrics["emi_explained"].item() == pytest.approx(1.0, abs=1e-6)


def test_the_error_model_shapes_itself_alone():
    objective, data = EMI(WIDE, SPEC), moves()
    frames = data.observations["x"].requires_grad_()
    objective(data, encode).losses["emi_error"].backward()
    assert frames.grad is None
    moved = {key.split(".")[0] for key, parameter in objective.named_parameters() if parameter.grad is not None}
    assert moved == {"error_model"}


def test_evaluation_is_deterministic_and_draws_nothing():
    objective, data = EMI(WIDE, SPEC).eval(), moves()
    state = torch.get_rng_state()
    first, second = objective(data, encode), objective(data, encode)
    assert torch.equal(torch.get_rng_state(), state)
    assert all(torch.equal(value, second.losses[name]) for name, value in first.losses.items())
    assert not list(objective.buffers())


def test_training_is_that_of_the_generator():
    data, outputs = moves(), []
    for _ in range(2):
        torch.manual_seed(4)
        outputs.append(EMI(WIDE, SPEC)(data, encode).losses)
    assert all(torch.equal(value, outputs[1][name]) for name, value in outputs[0].items())


def test_autocast_changes_nothing():
    objective, data = EMI(WIDE, SPEC).eval(), moves()
    plain = objective(data, encode).losses
    with torch.autocast("cpu", dtype=torch.bfloat16):
        cast = objective(data, encode).losses
    assert all(torch.equal(value, cast[name]) for name, value in plain.items())


def test_weights_reach_every_term():
    """A default weight is given to each but the dynamics, under the names that it logs."""
    names = set(EMI(WIDE, SPEC)(moves(), encode).losses)
    assert {name for name in DEFAULT_LOSS_WEIGHTS if name.startswith("emi_")} == names - {"emi_dynamics"}


def test_one_embedding_layer_is_all_that_touches_the_latent():
    objective = EMI(WIDE, SPEC, dimensions=3)
    assert isinstance(objective.state_embedding, nn.Linear) and objective.state_embedding.weight.shape == (3, WIDE)
