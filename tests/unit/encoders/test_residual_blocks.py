"""The residual encoder and decoder: any size, positions kept apart, every parameter trained."""

from __future__ import annotations

import pytest
import torch

from repdib_lightning.decoders import ResidualDecoder
from repdib_lightning.encoders import ResidualEncoder
from repdib_lightning.errors import UserError
from repdib_lightning.records import ArraySpec, DataSpec

SMALL = {"channels": 4, "stages": 2}


def spec_of(*shape):
    return DataSpec({"pixels": ArraySpec(shape)})


def pictures(spec, count=3):
    shape = spec.observations["pixels"].shape
    generator = torch.Generator().manual_seed(0)
    return {"pixels": torch.randint(0, 256, (count, *shape), dtype=torch.uint8, generator=generator)}


@pytest.mark.parametrize("grid", [False, True])
@pytest.mark.parametrize("shape", [(3, 16, 16), (1, 17, 9), (6, 20, 31)])
def test_any_size_comes_back_in_its_own_size(shape, grid):
    spec = spec_of(*shape)
    encoder = ResidualEncoder(spec, features=5, grid=grid, **SMALL)
    latents = encoder(pictures(spec))
    decoder = ResidualDecoder(spec, encoder.features, grid=grid, **SMALL)
    assert latents.shape == (3, encoder.features)
    assert decoder(latents).shape == (3, *shape)
    quarter = -(-shape[1] // 4) * -(-shape[2] // 4)
    assert (encoder.positions, encoder.features) == ((quarter, 5 * quarter) if grid else (1, 5))


def test_the_paper_s_size_is_built_and_drawn():
    spec = spec_of(3, 224, 224)
    encoder, decoder = ResidualEncoder(spec, stages=6, channels=4), ResidualDecoder(spec, 32, stages=6, channels=4)
    assert decoder(encoder(pictures(spec, 1))).shape == (1, 3, 224, 224)


@pytest.mark.parametrize("grid", [False, True])
def test_gradients_reach_every_parameter(grid):
    spec = spec_of(3, 12, 12)
    torch.manual_seed(0)
    encoder = ResidualEncoder(spec, features=4, grid=grid, blocks=2, **SMALL)
    decoder = ResidualDecoder(spec, encoder.features, grid=grid, blocks=2, **SMALL)
    decoder(encoder(pictures(spec))).square().mean().backward()
    for module in (encoder, decoder):
        for name, parameter in module.named_parameters():
            assert parameter.grad is not None and parameter.grad.abs().sum() > 0, name


def test_a_position_of_the_grid_sees_its_own_place():
    """Changing the lower right corner changes the last position's features, and not the first one's."""
    spec = spec_of(3, 32, 32)
    torch.manual_seed(0)
    # A normalisation over the whole map would let every position see everything.
    encoder = ResidualEncoder(spec, features=4, grid=True, channels=4, stages=2, blocks=0)
    batch = pictures(spec, 1)
    changed = {"pixels": batch["pixels"].clone()}
    changed["pixels"][..., 28:, 28:] = 255 - changed["pixels"][..., 28:, 28:]
    first, second = (encoder(seen).reshape(8, 8, 4) for seen in (batch, changed))
    assert torch.equal(first[:5, :5], second[:5, :5])
    assert not torch.allclose(first[7, 7], second[7, 7])


def test_the_decoder_reads_the_grid_in_the_encoder_s_order():
    """Changing the features of one position changes what is drawn around it, and not the opposite corner."""
    spec = spec_of(3, 32, 32)
    torch.manual_seed(0)
    decoder = ResidualDecoder(spec, 64 * 4, grid=True, channels=4, stages=2, blocks=0)
    latents = torch.randn(1, 64, 4)
    moved = latents.clone()
    moved[0, 7] += 3.0  # the first row's last column
    before, after = (decoder(values.flatten(1)) for values in (latents, moved))
    changed = (before != after).any(1)[0]
    assert changed[:4, 28:].any() and not changed[16:].any() and not changed[:, :16].any()


@pytest.mark.parametrize(
    ("options", "wanted"),
    [
        ({"stages": 5}, "ResidualEncoder: 5 stages are too many for 16 x 16 pixels; at most 3"),
        ({"stages": 0}, "stages (0) must be at least 1"),
        ({"features": 0, "stages": 2}, "features must be at least 1"),
        ({"views": ["front"]}, "which is no picture in the data"),
    ],
)
def test_what_does_not_fit_is_told(options, wanted):
    with pytest.raises(UserError) as told:
        ResidualEncoder(spec_of(3, 16, 16), **options)
    assert wanted in str(told.value)


def test_several_pictures_need_a_choice():
    spec = DataSpec({"left": ArraySpec((3, 16, 16)), "right": ArraySpec((3, 24, 24))})
    with pytest.raises(UserError, match=r"several pictures \(left, right\); choose one as view"):
        ResidualDecoder(spec, 4, **SMALL)
    with pytest.raises(UserError, match="a grid is of one picture, the data has left, right; choose one with views"):
        ResidualEncoder(spec, grid=True, **SMALL)
    assert set(ResidualEncoder(spec, grid=True, views=["right"], **SMALL).spec.observations) == {"right"}
    assert ResidualDecoder(spec, 4, view="right", **SMALL)(torch.zeros(1, 4)).shape == (1, 3, 24, 24)


def test_a_decoder_of_another_grid_is_told():
    with pytest.raises(UserError, match="2 stages leave 4 x 4 positions, which do not share a latent of 30"):
        ResidualDecoder(spec_of(3, 16, 16), 30, grid=True, **SMALL)
