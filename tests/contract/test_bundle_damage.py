"""Whatever happens to a bundle on disk: one line that names file and key, never a wrong encoder, never a traceback."""

from __future__ import annotations

import hashlib
import json
import random
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from safetensors.torch import load_file, save_file

from repdib_lightning.bottlenecks import RepDIB
from repdib_lightning.encoders import ConvolutionalEncoder
from repdib_lightning.errors import UserError
from repdib_lightning.export import load_encoder, save_bundle
from repdib_lightning.export.description import sealed
from repdib_lightning.export.formats import example_batch
from repdib_lightning.records import ActionSpec, ArraySpec, DataSpec

SPEC = DataSpec({"front": ArraySpec((3, 12, 12))}, ActionSpec("discrete", 5))
FLIPS = 200


@pytest.fixture(scope="module")
def intact(tmp_path_factory: pytest.TempPathFactory) -> Path:
    encoder = ConvolutionalEncoder(SPEC, features=8, channels=2, strides=[2])
    bottleneck = RepDIB(8, groups=2, codes=3, start_step=1)
    for _ in range(3):
        bottleneck(torch.randn(20, 8))
    folder = tmp_path_factory.mktemp("bundles") / "intact"
    return save_bundle(folder, encoder, bottleneck, training={"run": "x"}, data={"file": "arm.h5"})


@pytest.fixture
def bundle(intact: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(intact, tmp_path / "bundle"))


def refused(folder: Path) -> str:
    with pytest.raises(UserError) as caught:
        load_encoder(folder)
    assert "\n" not in str(caught.value)
    return str(caught.value)


def edit(folder: Path, change: Callable[[dict[str, Any]], object], *, reseal: bool = True) -> None:
    path = folder / "config.json"
    config = json.loads(path.read_text())
    change(config)
    path.write_text(json.dumps(sealed(config) if reseal else config))


def test_missing_parts(bundle: Path, tmp_path: Path) -> None:
    assert "nowhere: no such bundle" in refused(tmp_path / "nowhere")
    assert "a bundle is a folder" in refused(bundle / "config.json")
    (bundle / "model.safetensors").unlink()
    assert "model.safetensors: no such file" in refused(bundle)
    (bundle / "config.json").unlink()
    assert "config.json: no such file" in refused(bundle)


@pytest.mark.parametrize("content", [b"", b"{", b"\xff\xfe\x00", b"[" * 100_000, b'{"a": NaN}', b"9" * 5000])
def test_not_json(bundle: Path, content: bytes) -> None:
    (bundle / "config.json").write_bytes(content)
    assert "config.json: not valid JSON" in refused(bundle)


@pytest.mark.parametrize("content", [b"3", b"null", b"[]", b"{}", b'{"model_type": "bert"}'])
def test_somebody_elses_json(bundle: Path, content: bytes) -> None:
    (bundle / "config.json").write_bytes(content)
    assert "config.json: not a bundle of this package" in refused(bundle)


def test_each_key_is_needed_and_typed(bundle: Path, intact: Path) -> None:
    keys = json.loads((intact / "config.json").read_text())
    for key in set(keys) - {"format", "digest"}:
        edit(bundle, lambda config, key=key: config.pop(key))
        expected = "'files.model.safetensors'" if key == "files" else f"'{key}'"
        assert f"key {expected} is missing" in refused(bundle)
        for value in ("x" if key != "digest" else 3, None, True):
            shutil.copy(intact / "config.json", bundle / "config.json")
            edit(bundle, lambda config, key=key, value=value: config.update({key: value}))
            assert f"'{key}" in refused(bundle) or key == "files"
        shutil.copy(intact / "config.json", bundle / "config.json")
    edit(bundle, lambda config: config.pop("digest"), reseal=False)
    assert "key 'digest' is missing" in refused(bundle)


def test_a_newer_schema_is_named_before_anything_else(bundle: Path) -> None:
    edit(bundle, lambda config: config.update(schema_version=2, encoder="something new"), reseal=False)
    assert "'schema_version' 2 is newer than this package reads (1); upgrade" in refused(bundle)


def test_an_edit_by_hand_is_noticed(bundle: Path) -> None:
    edit(bundle, lambda config: config["spec"]["observations"]["front"].update(shape=[3, 13, 13]), reseal=False)
    assert "config.json: content does not match its 'digest'" in refused(bundle)


def test_another_layout_of_the_same_content_is_no_damage(bundle: Path, intact: Path) -> None:
    edit(bundle, lambda config: None)
    observations = example_batch(SPEC, 4)
    assert torch.equal(load_encoder(bundle).encode(observations), load_encoder(intact).encode(observations))


CHANGES: list[tuple[Callable[[dict[str, Any]], object], str]] = [
    (lambda c: c["encoder"].update({"class": "ConvolutionEncoder"}), "did you mean 'ConvolutionalEncoder'?"),
    (lambda c: c["encoder"].update({"class": "os.system"}), "'encoder.class' is unknown: 'os.system'"),
    (lambda c: c["bottleneck"].update({"class": "Repdib"}), "'bottleneck.class' is unknown: 'Repdib', did you mean"),
    (lambda c: c["bottleneck"].pop("class"), "key 'bottleneck.class' is missing"),
    (lambda c: c["encoder"].pop("arguments"), "key 'encoder.arguments' is missing"),
    (lambda c: c["encoder"]["arguments"].update(chanels=3), "'chanels', unknown to ConvolutionalEncoder; did you mean"),
    (lambda c: c["encoder"]["arguments"].update(spec=3), "'encoder.arguments' has 'spec'"),
    (lambda c: c["encoder"]["arguments"].update(self=3), "'encoder.arguments' has 'self'"),
    (lambda c: c["encoder"]["arguments"].update(features="8"), "'encoder.arguments' do not build"),
    (lambda c: c["encoder"]["arguments"].update(strides=[0]), "'encoder.arguments' do not build"),
    (lambda c: c["encoder"]["arguments"].update(views=["side"]), "'side'"),
    (lambda c: c["encoder"]["arguments"].update(features=2**50), "'encoder.arguments' do not build"),
    (lambda c: c["bottleneck"]["arguments"].update(groups=3), "'bottleneck.arguments' do not build a RepDIB"),
    (lambda c: c.update(features=9), "'features' is 9, the modules it describes have 8"),
    (lambda c: c.update(groups=4), "'groups' is 4"),
    (lambda c: c.update(codes=4), "'codes' is 4"),
    (lambda c: c["preprocessing"].update(scaling="by 255"), "'preprocessing'"),
    (lambda c: c.update(spec={}), "'spec.observations' is missing"),
    (lambda c: c["spec"].update(observations={}), "'spec.observations' is empty"),
    (lambda c: c["spec"]["observations"].update(front=[3]), "'spec.observations.front' must hold"),
    (lambda c: c["spec"]["observations"]["front"].update(shape=[3, -1, 2]), "'spec.observations.front.shape'"),
    (lambda c: c["spec"]["observations"]["front"].update(shape="3"), "'spec.observations.front.shape'"),
    (lambda c: c["spec"]["observations"]["front"].update(dtype="int8"), "'spec.observations.front.dtype'"),
    (lambda c: c["spec"].update(frame_stack=0), "'spec.frame_stack' must be at least 1"),
    (lambda c: c["spec"].update(actions={"kind": "joystick", "size": 3}), "'spec.actions'"),
    (lambda c: c["spec"]["observations"]["front"].update(shape=[3, 14, 14]), "tensor 'encoder.trunk.0.weight' has"),
    (
        lambda c: c["bottleneck"]["arguments"].update(codes=4) or c.update(codes=4),
        "has shape (2, 3, 4), config.json asks for (2, 4, 4)",
    ),
    (lambda c: c["bottleneck"]["arguments"].update(codebook="gradient"), "has no place in what config.json describes"),
]


@pytest.mark.parametrize(("change", "message"), CHANGES, ids=[message for _, message in CHANGES])
def test_wrong_but_sealed_content(bundle: Path, change: Callable[[dict[str, Any]], object], message: str) -> None:
    edit(bundle, change)
    said = refused(bundle)
    assert message in said
    assert "config.json" in said


def replace_tensors(folder: Path, change: Callable[[dict[str, torch.Tensor]], object]) -> None:
    path = folder / "model.safetensors"
    tensors = load_file(path)
    change(tensors)
    save_file(tensors, path)
    digest = hashlib.sha256(path.read_bytes()).hexdigest()
    edit(folder, lambda config: config["files"].update({"model.safetensors": digest}))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda t: t.pop("encoder.trunk.0.bias"), "'encoder.trunk.0.bias', which config.json asks for, is missing"),
        (lambda t: t.update(extra=torch.zeros(1)), "tensor 'extra' has no place"),
        (lambda t: t.update({"encoder.trunk.0.bias": torch.zeros(9)}), "has shape (9,), config.json asks for (8,)"),
        (lambda t: t.update({"encoder.trunk.0.bias": torch.zeros(8).half()}), "is torch.float16, config.json asks"),
    ],
)
def test_tensors_that_do_not_fit(bundle: Path, change: Callable[..., object], message: str) -> None:
    replace_tensors(bundle, change)
    said = refused(bundle)
    assert message in said and "model.safetensors" in said


def test_weights_of_another_bundle_are_noticed(bundle: Path) -> None:
    tensors = load_file(bundle / "model.safetensors")
    save_file({name: value + 1 for name, value in tensors.items()}, bundle / "model.safetensors")
    assert "model.safetensors: content does not match" in refused(bundle)


def test_resealed_garbage_weights_are_one_line(bundle: Path) -> None:
    for content in (b"", b"\xff" * 8, b"\x08\0\0\0\0\0\0\0{}      ", bytes(300)):
        (bundle / "model.safetensors").write_bytes(content)
        digest = hashlib.sha256(content).hexdigest()
        edit(bundle, lambda config, digest=digest: config["files"].update({"model.safetensors": digest}))
        assert "model.safetensors: " in refused(bundle)


@pytest.mark.parametrize("name", ["config.json", "model.safetensors"])
def test_every_cut_is_noticed(bundle: Path, name: str) -> None:
    content = (bundle / name).read_bytes()
    for length in {0, 1, 8, len(content) // 2, len(content) - 2}:
        (bundle / name).write_bytes(content[:length])
        assert name in refused(bundle)


@pytest.mark.parametrize("name", ["config.json", "model.safetensors"])
def test_flipped_bytes_are_refused_or_change_nothing(bundle: Path, intact: Path, name: str) -> None:
    """Only the blanks between JSON's words can change without a change of content."""
    path, generator, harmless = bundle / name, random.Random(name), 0
    content = path.read_bytes()
    observations = example_batch(SPEC, 4)
    expected = load_encoder(intact).encode(observations)
    for _ in range(FLIPS):
        place = generator.randrange(len(content))
        flipped = content[place] ^ generator.randrange(1, 256)
        path.write_bytes(content[:place] + bytes([flipped]) + content[place + 1 :])
        try:
            given = load_encoder(bundle)
        except UserError as error:
            assert name in str(error) and "\n" not in str(error)
        else:
            harmless += 1
            assert content[place : place + 1].isspace() and bytes([flipped]).isspace()
            assert torch.equal(given.encode(observations), expected)
    assert harmless <= FLIPS // 20
