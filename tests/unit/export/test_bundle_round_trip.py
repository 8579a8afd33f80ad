"""A bundle gives back what was saved: the same numbers, frozen, and only what fits its spec."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import nn

from repdib_lightning.bottlenecks import BOTTLENECKS, Bottleneck, Identity, RepDIB, VectorQuantiser
from repdib_lightning.encoders import ConvolutionalEncoder, Encoder, ResNetEncoder
from repdib_lightning.errors import UserError
from repdib_lightning.export import FrozenEncoder, load_encoder, save_bundle
from repdib_lightning.export.formats import example_batch
from repdib_lightning.records import ActionSpec, ArraySpec, DataSpec

TWO_VIEWS = DataSpec(
    {"front": ArraySpec((6, 16, 20)), "top": ArraySpec((3, 12, 12))}, ActionSpec("discrete", 5), horizon=4
)
ONE_VIEW = DataSpec({"front": ArraySpec((3, 16, 16))}, frame_stack=1)


def make_encoder(spec: DataSpec) -> Encoder:
    return ConvolutionalEncoder(spec, features=16, channels=4, strides=[2, 1])


def make_bottleneck(name: str = "RepDIB") -> Bottleneck:
    quantised = {"groups": 4, "codes": 5, "start_step": 1} if name in ("RepDIB", "VectorQuantiser") else {}
    bottleneck = BOTTLENECKS[name](16, **quantised)
    bottleneck.train()
    for _ in range(3):
        bottleneck(torch.randn(40, 16))
    return bottleneck.eval()


def save(folder: Path, spec: DataSpec = ONE_VIEW, name: str = "RepDIB") -> tuple[Encoder, Bottleneck]:
    encoder, bottleneck = make_encoder(spec).eval(), make_bottleneck(name)
    save_bundle(folder, encoder, bottleneck, training={"objective": "inverse", "steps": 3}, data={"file": "arm.h5"})
    return encoder, bottleneck


@pytest.mark.parametrize("name", sorted(BOTTLENECKS))
def test_same_numbers_before_and_after(tmp_path: Path, name: str) -> None:
    encoder, bottleneck = save(tmp_path / "bundle", TWO_VIEWS, name)
    frozen = load_encoder(tmp_path / "bundle")
    observations = example_batch(TWO_VIEWS, 9)
    with torch.no_grad():
        expected = bottleneck(encoder(observations))
    assert torch.equal(frozen.encode(observations), expected.latent)
    assert torch.equal(frozen.encode(observations), frozen.encode(observations))
    assert frozen.spec == TWO_VIEWS and frozen.features == 16
    assert (frozen.groups, frozen.codes_per_group) == (bottleneck.groups, bottleneck.codes)
    if frozen.groups:
        latent, codes = frozen.encode_with_codes(observations)
        assert torch.equal(codes, expected.codes) and torch.equal(frozen.codes(observations), codes)
        assert torch.equal(frozen.decode(codes), latent)
        assert torch.equal(frozen.decode(codes[0]), latent[0])
    else:
        with pytest.raises(UserError, match=f"no codes.*{name}"):
            frozen.codes(observations)
        with pytest.raises(UserError, match=f"no codes.*{name}"):
            frozen.decode(torch.zeros(1, 4, dtype=torch.int64))


def test_batch_statistics_survive(tmp_path: Path) -> None:
    spec = DataSpec({"front": ArraySpec((3, 32, 32))})
    encoder = ResNetEncoder(spec, features=8)
    encoder(example_batch(spec, 4))
    save_bundle(tmp_path / "b", encoder.eval(), Identity(8), training={}, data={})
    observations = example_batch(spec, 3, seed=1)
    with torch.no_grad():
        assert torch.equal(load_encoder(tmp_path / "b").encode(observations), encoder(observations))


def test_description_holds_the_facts_and_no_folders(tmp_path: Path) -> None:
    facts = {"file": tmp_path / "arm.h5", "fingerprint": "abc", "more": [str(tmp_path / "x" / "clip.mp4")]}
    save_bundle(tmp_path / "b", make_encoder(ONE_VIEW), Identity(16), training={"steps": 7}, data=facts)
    text = (tmp_path / "b" / "config.json").read_text()
    config = json.loads(text)
    assert config["data"] == {"file": "arm.h5", "fingerprint": "abc", "more": ["clip.mp4"]}
    assert str(tmp_path) not in text
    assert config["training"] == {"steps": 7} and config["schema_version"] == 1
    assert config["encoder"] == {"class": "ConvolutionalEncoder", "arguments": make_encoder(ONE_VIEW).arguments}
    assert load_encoder(tmp_path / "b").description == config


def test_nothing_trains_a_frozen_encoder(tmp_path: Path) -> None:
    save(tmp_path / "b")
    frozen = load_encoder(tmp_path / "b")
    before = {name: value.clone() for name, value in frozen.state_dict().items()}
    agent = nn.Sequential(frozen, nn.Linear(16, 2)).train()
    optimiser = torch.optim.SGD(agent.parameters(), lr=10.0, weight_decay=0.5)
    for _ in range(3):
        loss = agent[1](frozen.train()(example_batch(ONE_VIEW, 8))).square().mean()
        loss.backward()
        optimiser.step()
    assert not any(module.training for module in frozen.modules())
    assert not any(parameter.requires_grad for parameter in frozen.parameters())
    assert not frozen.encode(example_batch(ONE_VIEW, 2)).requires_grad
    assert all(torch.equal(value, before[name]) for name, value in frozen.state_dict().items())


def test_autocast_around_it_changes_nothing(tmp_path: Path) -> None:
    save(tmp_path / "b")
    frozen, observations = load_encoder(tmp_path / "b"), example_batch(ONE_VIEW, 4)
    with torch.autocast("cpu", dtype=torch.bfloat16):
        inside = frozen.encode(observations)
    assert inside.dtype == torch.float32 and torch.equal(inside, frozen.encode(observations))


def test_loading_leaves_the_random_state_alone(tmp_path: Path) -> None:
    save(tmp_path / "b")
    torch.manual_seed(5)
    expected = torch.rand(3)
    torch.manual_seed(5)
    load_encoder(tmp_path / "b")
    assert torch.equal(torch.rand(3), expected)


def test_every_form_of_the_same_observation_gives_the_same_latent(tmp_path: Path) -> None:
    save(tmp_path / "b", ONE_VIEW, "Variational")
    frozen: FrozenEncoder = load_encoder(tmp_path / "b")
    tensor = example_batch(ONE_VIEW, 3)["front"]
    expected = frozen.encode({"front": tensor})
    frozen_array = tensor.numpy().copy()
    frozen_array.setflags(write=False)
    reversed_view = tensor.numpy()[:, ::-1].copy()[:, ::-1]
    for form in (tensor, tensor.numpy(), frozen_array, reversed_view, {"front": tensor.numpy()}):
        assert torch.equal(frozen.encode(form), expected)
    single = frozen.encode(tensor[1])
    assert single.shape == (16,)
    torch.testing.assert_close(single, expected[1])
    assert frozen.encode(tensor[:0]).shape == (0, 16)


def test_wrong_observations_name_the_observation_and_both_shapes(tmp_path: Path) -> None:
    save(tmp_path / "one")
    save(tmp_path / "two", TWO_VIEWS)
    one, two = load_encoder(tmp_path / "one"), load_encoder(tmp_path / "two")
    picture = torch.zeros(2, 3, 16, 16, dtype=torch.uint8)
    views = example_batch(TWO_VIEWS, 2)
    wrong = [
        (one, torch.zeros(2, 3, 84, 84, dtype=torch.uint8), r"'front'.*\(2, 3, 84, 84\).*\(3, 16, 16\)"),
        (one, picture.movedim(1, -1), r"'front'.*\(2, 16, 16, 3\).*channels come first"),
        (one, picture[None], r"'front'.*\(1, 2, 3, 16, 16\)"),
        (one, picture.float(), r"'front' must be uint8.*is float32"),
        (one, picture.numpy().astype(np.float64), r"'front' must be uint8.*is float64"),
        (one, {"frnt": picture}, r"'frnt' is unknown.*did you mean 'front'"),
        (one, {}, r"'front' is missing"),
        (one, {"front": [[1]]}, r"'front' must be a numpy array or a tensor, is list"),
        (two, picture, r"takes 2 observations: front, top"),
        (two, {"front": views["front"]}, r"'top' is missing"),
        (two, {**views, "top": views["top"][:1]}, r"disagree on the batch: 'front' has 2, 'top' has 1"),
        (two, {**views, "top": views["top"][0]}, r"disagree on the batch: 'front' has 2, 'top' has none"),
    ]
    for frozen, given, message in wrong:
        with pytest.raises(UserError, match=message) as caught:
            frozen.encode(given)
        assert "\n" not in str(caught.value)


def test_wrong_codes_are_refused(tmp_path: Path) -> None:
    save(tmp_path / "b")
    frozen = load_encoder(tmp_path / "b")
    for codes, message in [
        (torch.full((2, 4), 5), r"in \[0, 5\), are in \[5, 5\]"),
        (torch.full((2, 4), -1), r"in \[0, 5\)"),
        (torch.zeros(2, 3, dtype=torch.int64), r"shape \(2, 3\), expected \(N, 4\)"),
        (torch.zeros(2, 4), r"whole numbers"),
    ]:
        with pytest.raises(UserError, match=message):
            frozen.decode(codes)


def test_an_existing_folder_is_kept_unless_overwrite(tmp_path: Path) -> None:
    save(tmp_path / "b", name="Identity")
    with pytest.raises(UserError, match="b: exists already"):
        save(tmp_path / "b")
    assert load_encoder(tmp_path / "b").groups == 0
    encoder, bottleneck = make_encoder(ONE_VIEW), make_bottleneck()
    save_bundle(tmp_path / "b", encoder, bottleneck, training={}, data={}, overwrite=True)
    assert load_encoder(tmp_path / "b").groups == 4
    assert [p.name for p in tmp_path.iterdir()] == ["b"]


def test_overwrite_never_deletes_what_is_no_bundle(tmp_path: Path) -> None:
    (tmp_path / "thesis").mkdir()
    (tmp_path / "thesis" / "chapter.tex").write_text("x")
    save(tmp_path / "b")
    (tmp_path / "b" / "notes.txt").write_text("x")
    (tmp_path / "file").write_text("x")
    for name, message in [("thesis", "no bundle"), ("b", "holds 'notes.txt'"), ("file", "no bundle")]:
        with pytest.raises(UserError, match=message):
            save_bundle(tmp_path / name, make_encoder(ONE_VIEW), Identity(16), training={}, data={}, overwrite=True)
    assert (tmp_path / "thesis" / "chapter.tex").exists() and (tmp_path / "b" / "notes.txt").exists()


def test_a_failed_write_leaves_nothing_or_the_previous_bundle(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    save(tmp_path / "b", name="Identity")

    def full_disk(path: Path) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("repdib_lightning.export.bundle.sync_file", full_disk)
    for name in ("b", "new"):
        with pytest.raises(UserError, match=f"{name}: cannot be written .No space left"):
            save_bundle(
                tmp_path / name, make_encoder(ONE_VIEW), make_bottleneck(), training={}, data={}, overwrite=True
            )
    assert [p.name for p in tmp_path.iterdir()] == ["b"]
    assert load_encoder(tmp_path / "b").groups == 0


def test_a_failed_swap_puts_the_previous_bundle_back(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    save(tmp_path / "b", name="Identity")
    from repdib_lightning.export import bundle

    rename = bundle.os.rename

    def failing(source: Path, target: Path) -> None:
        if ".tmp-" in Path(source).name:
            raise OSError(5, "Input/output error")
        rename(source, target)

    monkeypatch.setattr(bundle.os, "rename", failing)
    with pytest.raises(UserError, match="cannot be written"):
        save_bundle(tmp_path / "b", make_encoder(ONE_VIEW), make_bottleneck(), training={}, data={}, overwrite=True)
    assert [p.name for p in tmp_path.iterdir()] == ["b"]
    assert load_encoder(tmp_path / "b").groups == 0


def test_a_folder_that_cannot_be_made_is_one_line(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("x")
    with pytest.raises(UserError, match="cannot be written"):
        save(tmp_path / "file" / "b")


@pytest.mark.parametrize("kind", [VectorQuantiser, RepDIB])
def test_a_quantiser_that_has_not_started_is_refused(tmp_path: Path, kind: type[VectorQuantiser]) -> None:
    bottleneck = kind(16, groups=4, codes=5)
    with pytest.raises(UserError, match=r"not started.*start_step"):
        save_bundle(tmp_path / "b", make_encoder(ONE_VIEW), bottleneck, training={}, data={})
    assert not (tmp_path / "b").exists()


def test_weights_that_are_not_finite_are_refused(tmp_path: Path) -> None:
    encoder = make_encoder(ONE_VIEW)
    with torch.no_grad():
        encoder.trunk[0].weight[0, 0] = torch.nan
    with pytest.raises(UserError, match=r"'trunk\.0\.weight' is not finite"):
        save_bundle(tmp_path / "b", encoder, Identity(16), training={}, data={})


class Unlisted(ConvolutionalEncoder):
    """A class that no allow-list knows."""


def test_what_a_bundle_cannot_hold_is_refused(tmp_path: Path) -> None:
    unlisted = Unlisted(ONE_VIEW, features=16, channels=4, strides=[2])
    with pytest.raises(UserError, match=r"Unlisted: cannot be exported.*ConvolutionalEncoder"):
        save_bundle(tmp_path / "b", unlisted, Identity(16), training={}, data={})
    for value in (torch.zeros(2), float("nan"), {1, 2}):
        with pytest.raises(UserError, match=r"training\.x: a bundle holds plain values"):
            save_bundle(tmp_path / "b", make_encoder(ONE_VIEW), Identity(16), training={"x": value}, data={})
    with pytest.raises(UserError, match=r"unknown export format 'pt'.*did you mean 'pt2'"):
        save_bundle(tmp_path / "b", make_encoder(ONE_VIEW), Identity(16), training={}, data={}, formats=["pt"])
    assert not (tmp_path / "b").exists()


def test_an_unknown_device_is_one_line(tmp_path: Path) -> None:
    save(tmp_path / "b", name="Identity")
    with pytest.raises(UserError, match="device 'gpu' cannot be used"):
        load_encoder(tmp_path / "b", device="gpu")


@pytest.mark.parametrize("name", sorted(BOTTLENECKS))
def test_no_observations_give_no_latents(tmp_path: Path, name: str) -> None:
    save(tmp_path / "b", TWO_VIEWS, name)
    frozen, none = load_encoder(tmp_path / "b"), example_batch(TWO_VIEWS, 0)
    assert frozen.encode(none).shape == (0, 16) and frozen.encode(none).dtype == torch.float32
    if frozen.groups:
        assert frozen.codes(none).shape == (0, 4) and frozen.codes(none).dtype == torch.int64
        assert frozen.decode(frozen.codes(none)).shape == (0, 16)


def test_codes_are_decoded_from_numpy_too(tmp_path: Path) -> None:
    save(tmp_path / "b")
    frozen = load_encoder(tmp_path / "b")
    latent, codes = frozen.encode_with_codes(example_batch(ONE_VIEW, 3))
    for given in (codes.numpy(), codes.numpy().astype(np.uint16), codes.numpy()[::-1][::-1]):
        assert torch.equal(frozen.decode(given), latent)
    not_codes: list[tuple[Any, str]] = [
        (codes.numpy().astype(np.float32), "whole numbers, are torch.float32"),
        (codes.tolist(), "are list"),
        (np.array([["a"] * 4]), "are an array of"),
    ]
    for wrong, words in not_codes:
        with pytest.raises(UserError, match=words):
            frozen.decode(wrong)
