"""The optional forms: same numbers, any batch size, and a clear word where a package is missing."""

from __future__ import annotations

import hashlib
import importlib.util
import json
from pathlib import Path

import pytest
import torch

from repdib_lightning.bottlenecks import Bottleneck, RepDIB, Variational
from repdib_lightning.encoders import ConvolutionalEncoder
from repdib_lightning.errors import UserError
from repdib_lightning.export import FrozenEncoder, load_encoder, save_bundle
from repdib_lightning.export.formats import example_batch
from repdib_lightning.records import ArraySpec, DataSpec

SPEC = DataSpec({"front": ArraySpec((3, 12, 12)), "top": ArraySpec((3, 12, 12))})


def exported(folder: Path, bottleneck: Bottleneck, form: str) -> FrozenEncoder:
    encoder = ConvolutionalEncoder(SPEC, features=8, channels=2, strides=[2])
    for _ in range(3):
        bottleneck(torch.randn(40, 8))
    return load_encoder(save_bundle(folder, encoder, bottleneck, training={}, data={}, formats=[form]))


def test_a_program_gives_the_same_numbers_for_any_batch(tmp_path: Path) -> None:
    frozen = exported(tmp_path / "b", RepDIB(8, groups=2, codes=5, start_step=1), "pt2")
    program = torch.export.load(tmp_path / "b" / "model.pt2").module()
    for size in (1, 2, 33):
        observations = example_batch(SPEC, size, seed=size)
        latent, codes = program(observations)
        expected = frozen.encode_with_codes(observations)
        torch.testing.assert_close(latent, expected[0], rtol=0, atol=1e-5)
        assert torch.equal(codes, expected[1])
    files = json.loads((tmp_path / "b" / "config.json").read_text())["files"]
    assert files["model.pt2"] == hashlib.sha256((tmp_path / "b" / "model.pt2").read_bytes()).hexdigest()


def test_a_program_without_codes_returns_the_latent_alone(tmp_path: Path) -> None:
    frozen = exported(tmp_path / "b", Variational(8), "pt2")
    outputs = torch.export.load(tmp_path / "b" / "model.pt2").module()(example_batch(SPEC, 3))
    assert len(outputs) == 1
    torch.testing.assert_close(outputs[0], frozen.encode(example_batch(SPEC, 3)), rtol=0, atol=1e-5)


def test_onnx_without_its_packages_says_what_to_install(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    find_spec = importlib.util.find_spec
    monkeypatch.setattr(
        "importlib.util.find_spec", lambda name, *rest: None if name == "onnxscript" else find_spec(name, *rest)
    )
    with pytest.raises(UserError, match=r"format 'onnx' needs .*pip install .*onnxscript"):
        exported(tmp_path / "b", Variational(8), "onnx")
    assert not (tmp_path / "b").exists()


def test_onnx_gives_the_same_numbers_for_any_batch(tmp_path: Path) -> None:
    for package in ("onnx", "onnxscript"):
        pytest.importorskip(package)
    runtime = pytest.importorskip("onnxruntime")
    frozen = exported(tmp_path / "b", RepDIB(8, groups=2, codes=5, start_step=1), "onnx")
    session = runtime.InferenceSession(tmp_path / "b" / "model.onnx", providers=["CPUExecutionProvider"])
    for size in (1, 7):
        observations = example_batch(SPEC, size, seed=size)
        latent, codes = session.run(["latent", "codes"], {name: v.numpy() for name, v in observations.items()})
        expected = frozen.encode_with_codes(observations)
        torch.testing.assert_close(torch.from_numpy(latent), expected[0], rtol=0, atol=1e-5)
        assert torch.equal(torch.from_numpy(codes), expected[1])
