"""One contract for every encoder, and what is special about each."""

from __future__ import annotations

import pytest
import torch

from repdib_lightning.encoders import ENCODERS, ConvolutionalEncoder, ResNetEncoder, random_shift
from repdib_lightning.errors import UserError
from repdib_lightning.records import ArraySpec, DataSpec

OF_PICTURES = [name for name in ENCODERS if name != "MultimodalEncoder"]


def pictures(spec, count=3, seed=0):
    generator = torch.Generator().manual_seed(seed)
    return {
        name: torch.randint(0, 256, (count, *array.shape), dtype=torch.uint8, generator=generator)
        for name, array in spec.observations.items()
    }


SPECS = {
    "one view": DataSpec({"eye": ArraySpec((3, 64, 64))}),
    "two sizes": DataSpec({"front": ArraySpec((3, 64, 48)), "top": ArraySpec((1, 84, 84))}),
    "stack": DataSpec({"eye": ArraySpec((9, 84, 84))}, frame_stack=3),
}


@pytest.mark.parametrize("name", OF_PICTURES)
@pytest.mark.parametrize("spec", SPECS.values(), ids=SPECS)
def test_contract(name, spec):
    encoder = ENCODERS[name](spec, features=24)
    latent = encoder(pictures(spec))
    assert latent.shape == (3, encoder.features) == (3, 24) and latent.dtype == torch.float32
    latent.square().sum().backward()
    assert all(p.grad is not None and p.grad.abs().sum() > 0 for p in encoder.parameters())
    assert encoder.arguments["features"] == 24
    rebuilt = ENCODERS[name](spec, **encoder.arguments)
    rebuilt.load_state_dict(encoder.state_dict())
    inputs = pictures(spec)
    assert torch.equal(rebuilt.eval()(inputs), encoder.eval()(inputs))


@pytest.mark.parametrize("name", OF_PICTURES)
def test_evaluation_changes_no_buffer_and_sees_each_sample_alone(name):
    encoder = ENCODERS[name](SPECS["one view"], features=8).eval()
    before = {key: value.clone() for key, value in encoder.state_dict().items()}
    inputs = pictures(SPECS["one view"], count=5)
    together = encoder(inputs)
    alone = torch.cat([encoder({"eye": picture[None]}) for picture in inputs["eye"]])
    torch.testing.assert_close(together, alone, atol=1e-5, rtol=1e-4)
    assert all(torch.equal(value, before[key]) for key, value in encoder.state_dict().items())


def test_views_are_chosen_and_unknown_ones_named():
    spec = SPECS["two sizes"]
    encoder = ConvolutionalEncoder(spec, features=8, views=["top"]).eval()
    inputs = pictures(spec)
    changed = inputs | {"front": 255 - inputs["front"]}
    assert torch.equal(encoder(inputs), encoder(changed))
    with pytest.raises(UserError, match=r"'tob'.*did you mean 'top'"):
        ConvolutionalEncoder(spec, views=["tob"])
    with pytest.raises(UserError, match="needs at least one picture"):
        ConvolutionalEncoder(DataSpec({"joints": ArraySpec((7,), "float32")}))


def test_the_paper_width_at_84_pixels():
    """DrQ-v2's stack makes 32 * 35 * 35 features of an 84 px picture."""
    encoder = ConvolutionalEncoder(SPECS["stack"], features=50)
    assert encoder.trunk[0].in_features == 39_200


def test_the_convolutions_of_dqn_have_its_sizes():
    """Mnih et al. 2015: 84 px become 20, 9 and 7, so that 64 * 7 * 7 = 3136 numbers reach the linear layer."""
    spec = DataSpec({"frame": ArraySpec((4, 84, 84))}, frame_stack=4)
    encoder = ConvolutionalEncoder(spec, features=128, channels=[32, 64, 64], strides=[4, 2, 1], kernels=[8, 4, 3])
    shapes, seen = [], torch.zeros(1, 4, 84, 84)
    for layer in encoder.stacks["frame"]:
        seen = layer(seen)
        shapes.append(tuple(seen.shape[1:]))
    assert shapes[::2] == [(32, 20, 20), (64, 9, 9), (64, 7, 7)] and encoder.trunk[0].in_features == 3136
    rebuilt = ConvolutionalEncoder(spec, **encoder.arguments)
    rebuilt.load_state_dict(encoder.state_dict())
    assert torch.equal(rebuilt(pictures(spec)), encoder(pictures(spec)))


@pytest.mark.parametrize(
    ("sizes", "said"),
    [
        ({"channels": [8, 8]}, r"channels \(\[8, 8\]\), strides \(\[2, 1, 1, 1\]\), kernels .* equally long"),
        ({"kernels": [3]}, r"channels .*, strides .*, kernels \(\[3\]\) must be lists equally long"),
        ({"kernels": [3, 3, 3, 0]}, r"kernels \(\[3, 3, 3, 0\]\) must be at least 1"),
        ({"channels": 0}, r"channels \(\[0, 0, 0, 0\]\) must be at least 1"),
        ({"strides": []}, r"strides \(\[\]\) must be at least 1"),
    ],
)
def test_sizes_of_convolutions_that_do_not_fit_together_are_named(sizes, said):
    with pytest.raises(UserError, match=f"ConvolutionalEncoder: {said}"):
        ConvolutionalEncoder(SPECS["one view"], **sizes)


def test_a_picture_too_small_for_the_strides():
    with pytest.raises(
        UserError, match=r"'eye' of 12x12 pixels is too small for strides \[2, 2, 2\] of kernels \[3, 3, 3\]"
    ):
        ConvolutionalEncoder(DataSpec({"eye": ArraySpec((3, 12, 12))}), strides=[2, 2, 2])


def test_resnet_options():
    with pytest.raises(UserError, match="did you mean 'resnet18'"):
        ResNetEncoder(SPECS["one view"], architecture="resnet19")
    with pytest.raises(UserError, match="unknown norm"):
        ResNetEncoder(SPECS["one view"], norm="bach")
    grouped = ResNetEncoder(SPECS["one view"], features=8, norm="group")
    assert not any(isinstance(module, torch.nn.BatchNorm2d) for module in grouped.modules())


def test_random_shift_equals_padding_and_cropping():
    image = torch.randint(0, 256, (40, 3, 10, 12), dtype=torch.uint8)
    shifted = random_shift(image, 2)
    padded = torch.nn.functional.pad(image.float(), (2, 2, 2, 2), mode="replicate").to(torch.uint8)
    used = set()
    for before, after in zip(padded, shifted, strict=True):
        crops = {(y, x): before[:, y : y + 10, x : x + 12] for y in range(5) for x in range(5)}
        found = [place for place, crop in crops.items() if torch.equal(crop, after)]
        assert found
        used.update(found)
    assert len(used) > 10, "each picture has a shift of its own"
    assert random_shift(image, 0) is image
