"""Subtracting the mean picture of the training data."""

from __future__ import annotations

import pytest
import torch

from repdib_lightning.bottlenecks import Identity
from repdib_lightning.encoders import ConvolutionalEncoder
from repdib_lightning.encoders.mean_picture import MeanPicture
from repdib_lightning.encoders.views import centred
from repdib_lightning.export import load_encoder
from repdib_lightning.export.bundle import save_bundle
from repdib_lightning.records import ArraySpec, DataSpec

SHAPE = (4, 36, 40)
SPEC = DataSpec({"frame": ArraySpec(SHAPE)}, None, 4)


def pictures(count, seed):
    return torch.randint(0, 256, (count, *SHAPE), dtype=torch.uint8, generator=torch.Generator().manual_seed(seed))


def test_it_subtracts_the_mean_of_all_pictures_that_were_trained_on():
    module = MeanPicture(SHAPE)
    batches = [pictures(count, seed) for seed, count in enumerate((3, 7, 1))]
    for number, batch in enumerate(batches, 1):
        seen = centred(torch.cat(batches[:number]))
        torch.testing.assert_close(module(batch), centred(batch) - seen.mean(0))
    assert module.count == 11


def test_evaluation_changes_no_buffer_and_rows_do_not_depend_on_each_other():
    module = MeanPicture(SHAPE)
    module(pictures(8, 0))
    module.eval()
    before = {name: value.clone() for name, value in module.state_dict().items()}
    batch = pictures(5, 1)
    together = module(batch)
    assert all(torch.equal(value, before[name]) for name, value in module.state_dict().items())
    for row in range(5):
        assert torch.equal(module(batch[row : row + 1])[0], together[row])


def test_what_never_changes_becomes_zero():
    module = MeanPicture(SHAPE)
    batch = pictures(6, 0)
    batch[:, :, :10] = 77
    assert module(batch)[:, :, :10].abs().max() < 1e-6


def test_half_precision_keeps_the_mean():
    module = MeanPicture(SHAPE).to(torch.bfloat16)
    assert module.mean.dtype == module.count.dtype == torch.float32


@pytest.mark.parametrize("subtract", [False, True])
def test_an_encoder_learns_with_it_and_its_bundle_encodes_alike(tmp_path, subtract):
    torch.manual_seed(0)
    sizes = {"channels": [4, 8], "kernels": [8, 4], "strides": [4, 2]}
    encoder = ConvolutionalEncoder(SPEC, features=8, subtract_mean=subtract, **sizes)
    batch = {"frame": pictures(6, 0)}
    (encoder(batch) * torch.arange(8)).sum().backward()
    assert all(parameter.grad is not None and parameter.grad.any() for parameter in encoder.parameters())
    encoder.eval()
    save_bundle(tmp_path / "bundle", encoder, Identity(8), training={}, data={})
    loaded = load_encoder(tmp_path / "bundle")
    torch.testing.assert_close(loaded.encode(batch), encoder(batch))
    assert bool([name for name in encoder.state_dict() if name.startswith("means.")]) == subtract
