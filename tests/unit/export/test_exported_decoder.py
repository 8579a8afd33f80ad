"""A bundle with a decoder: the same drawings before and after, for one code a group and for a grid of them."""

from __future__ import annotations

import json

import pytest
import torch

from repdib_lightning.bottlenecks import RepDIB, for_positions
from repdib_lightning.decoders import ResidualDecoder
from repdib_lightning.encoders import ConvolutionalEncoder, ResidualEncoder
from repdib_lightning.errors import UserError
from repdib_lightning.export import load_decoder, load_encoder, save_bundle
from repdib_lightning.export.formats import example_batch
from repdib_lightning.records import ArraySpec, DataSpec

SPEC = DataSpec({"pixels": ArraySpec((3, 16, 16))}, horizon=0)
SMALL = {"channels": 4, "stages": 2}


def parts(grid):
    torch.manual_seed(0)
    encoder = ResidualEncoder(SPEC, features=4, grid=grid, **SMALL)
    quantised = {"groups": 2, "codes": 5, "start": "random", "start_step": 0}
    bottleneck = for_positions(lambda width: RepDIB(width, **quantised), encoder.features, encoder.positions)
    decoder = ResidualDecoder(SPEC, encoder.features, grid=grid, **SMALL)
    return encoder.eval(), bottleneck.eval(), decoder.eval()


def save(folder, grid=False, **options):
    encoder, bottleneck, decoder = parts(grid)
    save_bundle(folder, encoder, bottleneck, training={}, data={}, decoder=decoder, **options)
    return encoder, bottleneck, decoder


@pytest.mark.parametrize("grid", [False, True])
def test_the_same_codes_latents_and_drawings(tmp_path, grid):
    encoder, bottleneck, decoder = save(tmp_path / "bundle", grid)
    frozen, drawing = load_encoder(tmp_path / "bundle"), load_decoder(tmp_path / "bundle")
    seen = example_batch(SPEC, 6)
    with torch.no_grad():
        wanted = bottleneck(encoder(seen))
        drawn = decoder(wanted.latent)
    latents, codes = frozen.encode_with_codes(seen)
    assert torch.equal(latents, wanted.latent) and torch.equal(codes, wanted.codes)
    assert frozen.groups == (32 if grid else 2) and frozen.features == (64 if grid else 4)
    assert torch.equal(drawing(latents), drawn)
    torch.testing.assert_close(drawing(frozen.decode(codes)), drawn)
    assert not drawing.training and not any(parameter.requires_grad for parameter in drawing.parameters())


def test_other_programs_read_a_grid_too(tmp_path):
    save(tmp_path / "bundle", True, formats="pt2")
    frozen = load_encoder(tmp_path / "bundle")
    program = torch.export.load(tmp_path / "bundle" / "model.pt2").module()
    seen = example_batch(SPEC, 5)
    torch.testing.assert_close(program(seen)[0], frozen.encode(seen))


def test_a_bundle_without_a_decoder_says_so(tmp_path):
    encoder = ConvolutionalEncoder(SPEC, features=4, channels=2, strides=[2]).eval()
    bottleneck = RepDIB(4, groups=2, codes=3, start="random", start_step=0)
    save_bundle(tmp_path / "bundle", encoder, bottleneck, training={}, data={})
    with pytest.raises(UserError, match=r"config\.json: has no decoder; only an objective that draws pictures"):
        load_decoder(tmp_path / "bundle")


@pytest.mark.parametrize("damage", ["gone", "cut", "swapped"])
def test_damaged_weights_are_told(tmp_path, damage):
    save(tmp_path / "bundle")
    weights = tmp_path / "bundle" / "model.decoder.safetensors"
    content = weights.read_bytes()
    weights.unlink()
    if damage != "gone":
        weights.write_bytes(content[:-8] if damage == "cut" else (tmp_path / "bundle/model.safetensors").read_bytes())
    with pytest.raises(UserError, match=r"model\.decoder\.safetensors: (no such file|content does not match)"):
        load_decoder(tmp_path / "bundle")
    load_encoder(tmp_path / "bundle")  # which needs no decoder


def test_a_decoder_that_is_not_finite_is_not_exported(tmp_path):
    encoder, bottleneck, decoder = parts(False)
    decoder.last.bias.data[0] = float("nan")
    with pytest.raises(UserError, match=r"ResidualDecoder: parameter 'last\.bias' is not finite"):
        save_bundle(tmp_path / "bundle", encoder, bottleneck, training={}, data={}, decoder=decoder)
    assert not (tmp_path / "bundle").exists()


def test_a_bundle_is_replaced_with_and_without_a_decoder(tmp_path):
    save(tmp_path / "bundle")
    encoder, bottleneck, _ = parts(False)
    save_bundle(tmp_path / "bundle", encoder, bottleneck, training={}, data={}, overwrite=True)
    assert "decoder" not in json.loads((tmp_path / "bundle/config.json").read_text())
    assert not (tmp_path / "bundle/model.decoder.safetensors").exists()
