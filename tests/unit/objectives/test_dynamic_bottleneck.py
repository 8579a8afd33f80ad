"""The dynamic bottleneck: what its code keeps and drops, and a momentum copy that only training moves."""

from __future__ import annotations

import copy
import math

import torch
from torch import nn

from repdib_lightning.loss_weights import DEFAULT_LOSS_WEIGHTS
from repdib_lightning.objectives import DynamicBottleneck
from repdib_lightning.objectives.momentum import MomentumCopy
from repdib_lightning.records import ActionSpec, ArraySpec, Batch, DataSpec

M = 6
SPEC = DataSpec({"x": ArraySpec((M,), "float32")}, ActionSpec("discrete", 3), next_frame=True)
SMALL = {"code": 4, "hidden": 32, "projection": 8}


def built(**options):
    torch.manual_seed(0)
    return DynamicBottleneck(M, SPEC, **{**SMALL, **options})


def encode(observations):
    return observations["x"]


def transitions(count=64):
    """Half of the latent goes on as the action says, the other half is drawn anew in every frame."""
    frames, actions = torch.randn(count, 2, M), torch.randint(0, 3, (count,))
    frames[:, 1, :3] = 0.8 * frames[:, 0, :3] + 0.6 * torch.eye(3)[actions]
    return Batch({"x": frames}, actions, torch.tensor([[0, 1]]).expand(count, 2), torch.arange(count))


def weighted(losses, **weights):
    chosen = {**DEFAULT_LOSS_WEIGHTS, **weights}
    return sum(chosen[name] * value for name, value in losses.items())


def train(objective, steps=300, **weights):
    optimiser = torch.optim.Adam(objective.parameters(), 3e-3)
    for _ in range(steps):
        output = objective(transitions(128), encode)
        optimiser.zero_grad()
        weighted(output.losses, **weights).backward()
        optimiser.step()
    return output


def test_the_code_keeps_what_goes_on_and_drops_what_does_not():
    """At equal weights of the three terms, as published."""
    objective = built()
    output = train(objective)
    assert output.metrics["db_contrast_nats"] > 0.2 and output.losses["db_kl"] > 0.3
    latents = torch.randn(256, M, requires_grad=True)
    mean, _ = objective.encode_transition(latents, torch.eye(3)[torch.zeros(256, dtype=torch.int64)])
    (gradient,) = torch.autograd.grad(mean.square().sum(), latents)
    kept, dropped = gradient[:, :3].abs().mean(), gradient[:, 3:].abs().mean()
    assert kept > 3 * dropped


def test_a_heavier_kl_lets_less_through():
    light, heavy = train(built(), steps=150, db_kl=0.001), train(built(), steps=150, db_kl=10.0)
    assert heavy.losses["db_kl"] < 0.1 * light.losses["db_kl"]
    assert heavy.metrics["db_contrast_nats"] < 0.1 < light.metrics["db_contrast_nats"]


def test_the_information_bounds_agree_in_direction():
    """log N - contrast cannot exceed what the code holds of the past, which the KL bounds."""
    output = train(built(), steps=200)
    assert output.metrics["db_contrast_nats"] < output.losses["db_kl"] + 0.1
    assert output.metrics["db_contrast_nats"] < math.log(128)


def test_only_training_moves_the_momentum_copy():
    objective, data = built(momentum_rate=0.25), transitions()
    start = {name: value.clone() for name, value in objective.named_buffers()}
    weights = {name.replace(".", "_"): value for name, value in objective.projection.named_parameters()}
    assert {name.removeprefix("momentum.") for name in start} == set(weights)
    with torch.no_grad():
        for value in weights.values():
            value.add_(1.0)
    objective.eval()
    objective(data, encode)
    assert all(torch.equal(value, start[name]) for name, value in objective.named_buffers())
    objective.train()
    objective(data, encode)
    for name, value in objective.named_buffers():
        torch.testing.assert_close(value, start[name] + 0.25)
    assert not any(value.requires_grad for value in objective.buffers())


def test_no_gradient_enters_through_the_next_latent_or_the_copy():
    objective, data = built(), transitions()
    frames = data.observations["x"].requires_grad_()
    sum(objective(data, encode).losses.values()).backward()
    assert frames.grad[:, 0].abs().sum() > 0 and frames.grad[:, 1].abs().sum() == 0


def test_evaluation_is_deterministic_and_draws_nothing():
    objective, data = built().eval(), transitions()
    state = torch.get_rng_state()
    first, second = objective(data, encode), objective(data, encode)
    assert torch.equal(torch.get_rng_state(), state)
    assert all(torch.equal(value, second.losses[name]) for name, value in first.losses.items())


def test_a_saved_state_goes_on_exactly():
    first, data = built(momentum_rate=0.3), transitions()
    train(first, steps=3)
    second = DynamicBottleneck(M, SPEC, **SMALL, momentum_rate=0.3)
    second.load_state_dict(copy.deepcopy(first.state_dict()))
    outputs = []
    for objective in (first, second):
        torch.manual_seed(9)
        outputs.append(objective(data, encode).losses)
    assert all(torch.equal(value, outputs[1][name]) for name, value in outputs[0].items())
    assert all(torch.equal(value, second.state_dict()[name]) for name, value in first.state_dict().items())


def test_latents_far_away_and_close_together_are_told_apart_as_well():
    """A latent's place and scale are the encoder's: the losses must not depend on either at the target."""
    objective, data = built().eval(), transitions()
    wanted = objective(data, encode).losses
    moved = data.observations["x"].clone()
    moved[:, 1] = 10 + 0.1 * moved[:, 1]
    other = objective(Batch({"x": moved}, data.actions, data.offsets, data.rows), encode).losses
    for name, value in wanted.items():
        torch.testing.assert_close(other[name], value, rtol=1e-3, atol=1e-4, msg=name)


def test_autocast_changes_nothing():
    objective, data = built().eval(), transitions()
    plain = objective(data, encode).losses
    with torch.autocast("cpu", dtype=torch.bfloat16):
        cast = objective(data, encode).losses
    assert all(torch.equal(value, cast[name]) for name, value in plain.items())


def test_a_momentum_copy_stays_precise_in_half_precision():
    layer = nn.Linear(4, 4)
    average = MomentumCopy(layer, 0.001)
    both = nn.ModuleList([layer, average]).to(torch.bfloat16)
    before = average.weight.clone()
    with torch.no_grad():
        layer.weight.add_(1.0)
    average.follow(layer)
    assert average.weight.dtype == torch.float32 and both[0].weight.dtype == torch.bfloat16
    torch.testing.assert_close(average.weight - before, torch.full((4, 4), 0.001), rtol=0.05, atol=1e-5)
    assert average.apply_to(layer, torch.ones(2, 4, dtype=torch.bfloat16)).dtype == torch.float32
