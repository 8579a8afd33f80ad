"""Reconstruction: the loss of a slow loop, a picture that is learned, and samples without futures."""

from __future__ import annotations

import math

import pytest
import torch

from repdib_lightning.bottlenecks import Identity
from repdib_lightning.decoders import ResidualDecoder
from repdib_lightning.encoders import ResidualEncoder
from repdib_lightning.errors import UserError
from repdib_lightning.objectives import (
    DRIML,
    EMI,
    DynamicBottleneck,
    ForwardPrediction,
    InfoNCE,
    InverseDynamics,
    Reconstruction,
    SeveralObjectives,
)
from repdib_lightning.records import ActionSpec, ArraySpec, Batch, DataSpec
from repdib_lightning.representation import RepresentationModule

SPEC = DataSpec({"pixels": ArraySpec((3, 8, 8))}, ActionSpec("discrete", 3), horizon=0)
SMALL = {"channels": 4, "stages": 1}


def small_decoder(spec, width):
    return ResidualDecoder(spec, width, **SMALL)


def small_reconstruction(width, spec):
    return Reconstruction(width, spec, decoder=small_decoder)


def batch(count=4, frames=2):
    generator = torch.Generator().manual_seed(0)
    seen = torch.randint(0, 256, (count, frames, 3, 8, 8), dtype=torch.uint8, generator=generator)
    return Batch({"pixels": seen}, None, torch.zeros(count, frames, dtype=torch.int64), torch.arange(count))


def test_the_loss_and_the_psnr_are_those_of_a_slow_loop():
    torch.manual_seed(0)
    objective = Reconstruction(5, SPEC, decoder=small_decoder)
    latents = torch.randn(4, 2, 5)
    data = batch()
    output = objective(data, lambda _: latents)
    total, clipped, count = 0.0, 0.0, 0
    for i in range(4):
        for f in range(2):
            drawn = objective.decoder(latents[i, f][None])[0]
            bytes_seen = data.observations["pixels"][i, f].flatten().tolist()
            for value, byte in zip(drawn.flatten().tolist(), bytes_seen, strict=True):
                total += (value - byte / 255) ** 2
                clipped += (min(max(value, 0.0), 1.0) - byte / 255) ** 2
                count += 1
    assert output.losses["reconstruction"].item() == pytest.approx(total / count, rel=1e-5)
    assert float(output.metrics["psnr"]) == pytest.approx(10 * math.log10(count / clipped), rel=1e-5)


def test_a_few_pictures_are_learned():
    torch.manual_seed(0)
    encoder, objective = ResidualEncoder(SPEC, features=16, **SMALL), Reconstruction(16, SPEC, decoder=small_decoder)
    data = batch(6, 1)
    data.observations["pixels"][:] = data.observations["pixels"][..., :1, :1]  # plain colours
    optimizer = torch.optim.Adam([*encoder.parameters(), *objective.parameters()], lr=5e-3)
    found = []
    for _ in range(300):
        output = objective(data, lambda seen: encoder({"pixels": seen["pixels"].flatten(0, 1)}).unflatten(0, (6, 1)))
        optimizer.zero_grad()
        output.losses["reconstruction"].backward()
        optimizer.step()
        found.append(float(output.metrics["psnr"]))
    assert found[-1] > found[0] + 10.0, (found[0], found[-1])


def test_the_decoder_is_found_wherever_it_stands():
    alone = Reconstruction(5, SPEC, decoder=small_decoder)
    assert alone.find_decoder() == ("decoder", alone.decoder)
    spec = DataSpec(SPEC.observations, SPEC.actions)
    several = SeveralObjectives(5, spec, parts=[InverseDynamics, small_reconstruction])
    name, decoder = several.find_decoder()
    assert name == "parts.1.decoder" and decoder is several.parts[1].decoder
    assert InverseDynamics(5, spec).find_decoder() is None


@pytest.mark.parametrize("kind", [InverseDynamics, DRIML, InfoNCE, EMI, DynamicBottleneck, ForwardPrediction])
def test_what_compares_frames_refuses_samples_of_one(kind):
    with pytest.raises(UserError) as told:
        kind(5, SPEC)
    assert "data.futures" in str(told.value) or "data.next_frame" in str(told.value)


@pytest.mark.parametrize(
    ("shift", "view", "complaint"),
    [
        (4, "left", "model.shift is 4: Reconstruction would have to guess"),
        (0, "right", "draws 'right', the encoder sees left"),
    ],
)
def test_what_could_not_be_drawn_or_exported_is_refused_before_training(shift, view, complaint):
    spec = DataSpec({"left": ArraySpec((3, 16, 16)), "right": ArraySpec((3, 16, 16))}, horizon=0)
    model = RepresentationModule(
        lambda spec: ResidualEncoder(spec, features=4, views=["left"], **SMALL),
        Identity,
        lambda width, spec: Reconstruction(width, spec, decoder=lambda s, w: ResidualDecoder(s, w, view=view, **SMALL)),
        shift=shift,
    )
    with pytest.raises(UserError, match=complaint):
        model.build(spec)
