"""The frame t + 1 beside the drawn futures: objectives that do not ask for it are not changed by it."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from repdib_lightning.errors import UserError
from repdib_lightning.objectives import (
    DRIML,
    EMI,
    DynamicBottleneck,
    ForwardPrediction,
    InfoNCE,
    InverseDynamics,
    SeveralObjectives,
)
from repdib_lightning.records import ActionSpec, ArraySpec, Batch, DataSpec

PLAIN = DataSpec({"x": ArraySpec((6,), "float32")}, ActionSpec("discrete", 3), horizon=4)
WITH_NEXT = replace(PLAIN, next_frame=True)


def batch(count=5, futures=2):
    generator = torch.Generator().manual_seed(0)
    offsets = torch.randint(1, 5, (count, 1 + futures), generator=generator)
    offsets[:, 0] = 0
    frames = torch.randn(count, 1 + futures, 6, generator=generator)
    return Batch({"x": frames}, torch.randint(0, 3, (count,), generator=generator), offsets, torch.arange(count))


def with_next(data):
    frames, ones = data.observations["x"], torch.ones_like(data.offsets[:, :1])
    frames = torch.cat([frames[:, :1], 100 * torch.randn(len(data), 1, 6), frames[:, 1:]], 1)
    return Batch({"x": frames}, data.actions, torch.cat([data.offsets[:, :1], ones, data.offsets[:, 1:]], 1), data.rows)


def encode(observations):
    return observations["x"]


@pytest.mark.parametrize("kind", [InverseDynamics, DRIML, InfoNCE])
def test_the_loss_is_the_same_with_and_without_it(kind):
    outputs = []
    for spec, data in ((PLAIN, batch()), (WITH_NEXT, with_next(batch()))):
        torch.manual_seed(0)
        outputs.append(kind(6, spec)(data, encode))
    for name, value in (outputs[0].losses | outputs[0].metrics).items():
        assert torch.equal(value, (outputs[1].losses | outputs[1].metrics)[name]), name


@pytest.mark.parametrize("kind", [ForwardPrediction, EMI, DynamicBottleneck])
def test_those_that_need_it_say_so(kind):
    with pytest.raises(UserError, match=rf"{kind.__name__}: needs the frame after .* set data.next_frame to true"):
        kind(6, PLAIN)
    with pytest.raises(UserError, match=rf"{kind.__name__}: follows actions .* the data has none"):
        kind(6, DataSpec(PLAIN.observations, horizon=4, next_frame=True))
    assert kind(6, WITH_NEXT).needs_actions
    kind(6, replace(PLAIN, horizon=1))


@pytest.mark.parametrize("kind", [ForwardPrediction, EMI, DynamicBottleneck])
def test_those_that_need_it_look_at_no_other_future(kind):
    data = with_next(batch())
    data.observations["x"].requires_grad_()
    output = kind(6, WITH_NEXT)(data, encode)
    (gradient,) = torch.autograd.grad(sum(output.losses.values()), data.observations["x"])
    assert gradient[:, 0].abs().sum() > 0 and gradient[:, 2:].abs().sum() == 0


@pytest.mark.parametrize("kind", [ForwardPrediction, EMI, DynamicBottleneck])
def test_a_batch_of_one_is_refused_in_training_and_harmless_after(kind):
    objective, alone = kind(6, WITH_NEXT), with_next(batch(count=1))
    with pytest.raises(UserError, match=rf"data.batch_size is 1: {kind.__name__} .* needs at least 2"):
        objective(alone, encode)
    output = objective.eval()(alone, encode)
    assert all(torch.isfinite(value) for value in (output.losses | output.metrics).values())


@pytest.mark.parametrize(
    ("kind", "options", "message"),
    [
        (ForwardPrediction, {"hidden": 0}, "ForwardPrediction: hidden must be at least 1, is 0"),
        (EMI, {"dimensions": 0}, "EMI: dimensions must be at least 1, is 0"),
        (EMI, {"error_hidden": -1}, "EMI: error_hidden must be at least 1, is -1"),
        (DynamicBottleneck, {"code": 0}, "DynamicBottleneck: code must be at least 1, is 0"),
        (DynamicBottleneck, {"momentum_rate": 0.0}, r"momentum_rate must be in \(0, 1\], is 0.0"),
        (SeveralObjectives, {"parts": []}, "SeveralObjectives: parts is empty"),
    ],
)
def test_bad_options(kind, options, message):
    with pytest.raises(UserError, match=message):
        kind(6, WITH_NEXT, **options)


def test_several_objectives_share_one_encoding_and_keep_their_losses():
    data, passes = with_next(batch()), []

    def counting(observations):
        passes.append(observations["x"].shape)
        return observations["x"]

    torch.manual_seed(0)
    several = SeveralObjectives(6, WITH_NEXT, parts=[InverseDynamics, InfoNCE, ForwardPrediction])
    output = several(data, counting)
    assert passes == [(5, 4, 6)]
    for part in several.parts:
        alone = part(data, encode)
        for name, value in (alone.losses | alone.metrics).items():
            assert torch.equal((output.losses | output.metrics)[name], value), name
    assert set(output.losses) == {"inverse", "contrast", "forward"}
    assert several.needs_actions
    assert several.label == "InverseDynamics + InfoNCE + ForwardPrediction"
    assert not SeveralObjectives(6, WITH_NEXT, parts=[InfoNCE]).needs_actions


def test_names_that_collide_are_told():
    several = SeveralObjectives(6, WITH_NEXT, parts=[InverseDynamics, DRIML, InfoNCE])
    with pytest.raises(UserError, match="DRIML and InfoNCE both give 'contrast'; leave one of them out"):
        several(with_next(batch()), encode)
