"""The verb ``export RUN``: from a run's description and newest good checkpoint to a bundle."""

from __future__ import annotations

import copy
import json
from pathlib import Path
from typing import Any

import pytest
import torch

from repdib_lightning.bottlenecks import Identity, VectorQuantiser
from repdib_lightning.callbacks.checkpoint_files import step_path
from repdib_lightning.callbacks.checkpoint_io import AtomicCheckpointIO
from repdib_lightning.encoders import ConvolutionalEncoder
from repdib_lightning.errors import UserError
from repdib_lightning.export import export_run, load_encoder, write_model_description
from repdib_lightning.export.formats import example_batch
from repdib_lightning.records import ArraySpec, DataSpec

SPEC = DataSpec({"front": ArraySpec((3, 12, 12))})
Model = tuple[ConvolutionalEncoder, VectorQuantiser]


def write_checkpoint(run: Path, step: int, model: Model, **more: torch.Tensor) -> Path:
    encoder, bottleneck = model
    state = {f"encoder.{name}": value for name, value in encoder.state_dict().items()}
    state |= {f"bottleneck.{name}": value for name, value in bottleneck.state_dict().items()}
    state |= {"objective.head.weight": torch.zeros(3), **more}
    content: dict[str, Any] = {"state_dict": state, "global_step": step, "optimizer_states": [{"lr": 0.1}]}
    path = step_path(run / "checkpoints", step)
    path.parent.mkdir(parents=True, exist_ok=True)
    AtomicCheckpointIO().save_checkpoint(content, path)
    return path


def train_a_little(model: Model) -> Model:
    encoder, bottleneck = model
    bottleneck.train()
    with torch.no_grad():
        encoder.trunk[0].weight.add_(0.1 * torch.randn_like(encoder.trunk[0].weight))
        for _ in range(3):
            bottleneck(encoder(example_batch(SPEC, 40)))
    return encoder, bottleneck


@pytest.fixture
def run(tmp_path: Path) -> tuple[Path, Model, Model]:
    """A run folder with a description from before training and checkpoints after steps 3 and 6."""
    folder = tmp_path / "runs" / "arm"
    model = (
        ConvolutionalEncoder(SPEC, features=8, channels=2, strides=[2]),
        VectorQuantiser(8, groups=2, codes=3, start_step=1),
    )
    write_model_description(folder, *model, training={"objective": "inverse"}, data={"file": tmp_path / "arm.h5"})
    early = copy.deepcopy(train_a_little(model))
    write_checkpoint(folder, 3, early)
    late = train_a_little(model)
    write_checkpoint(folder, 6, late)
    return folder, early, late


def latents(model: Model, observations: dict[str, torch.Tensor]) -> torch.Tensor:
    with torch.no_grad():
        result: torch.Tensor = model[1].eval()(model[0].eval()(observations)).latent
    return result


def test_the_newest_checkpoint_is_exported(run: tuple[Path, Model, Model]) -> None:
    folder, early, late = run
    bundle = export_run(folder)
    assert bundle == folder / "bundle"
    frozen, observations = load_encoder(bundle), example_batch(SPEC, 6)
    assert torch.equal(frozen.encode(observations), latents(late, observations))
    assert not torch.equal(frozen.encode(observations), latents(early, observations))
    assert frozen.description["training"] == {"run": "arm", "objective": "inverse", "steps": 6}
    assert frozen.description["data"] == {"file": "arm.h5"}


def test_a_damaged_newest_checkpoint_is_passed_over(run: tuple[Path, Model, Model], tmp_path: Path) -> None:
    folder, early, _ = run
    newest = step_path(folder / "checkpoints", 6)
    content = bytearray(newest.read_bytes())
    content[len(content) // 2] ^= 1
    newest.write_bytes(content)
    frozen, observations = load_encoder(export_run(folder, tmp_path / "out")), example_batch(SPEC, 6)
    assert torch.equal(frozen.encode(observations), latents(early, observations))
    assert frozen.description["training"]["steps"] == 3


def test_an_existing_bundle_needs_overwrite(run: tuple[Path, Model, Model]) -> None:
    folder = run[0]
    export_run(folder)
    with pytest.raises(UserError, match="bundle: exists already"):
        export_run(folder)
    assert export_run(folder, overwrite=True) == folder / "bundle"


def test_what_is_missing_is_named(run: tuple[Path, Model, Model], tmp_path: Path) -> None:
    folder = run[0]
    with pytest.raises(UserError, match="nowhere: no such run folder"):
        export_run(tmp_path / "nowhere")
    with pytest.raises(UserError, match=r"holds no bundle\.json"):
        export_run(tmp_path)
    for path in (folder / "checkpoints").iterdir():
        path.unlink()
    with pytest.raises(UserError, match=r"arm: has no checkpoint yet: nothing to export"):
        export_run(folder)
    assert not (folder / "bundle").exists()


def test_a_damaged_description_is_refused(run: tuple[Path, Model, Model]) -> None:
    path = run[0] / "bundle.json"
    config = json.loads(path.read_text())
    config["bottleneck"]["arguments"]["codes"] = 4
    path.write_text(json.dumps(config))
    with pytest.raises(UserError, match=r"bundle\.json: content does not match its 'digest'"):
        export_run(run[0])


def test_a_checkpoint_of_another_model_is_refused(run: tuple[Path, Model, Model]) -> None:
    folder, _, (encoder, bottleneck) = run
    other = ConvolutionalEncoder(SPEC, features=8, channels=3, strides=[2])
    write_checkpoint(folder, 9, (other, bottleneck))
    with pytest.raises(UserError, match=r"step-00000009\.ckpt: tensor 'encoder\.\S+' has shape .*bundle\.json"):
        export_run(folder)
    write_checkpoint(folder, 12, (encoder, bottleneck), **{"encoder.extra": torch.zeros(1)})
    with pytest.raises(UserError, match=r"step-00000012\.ckpt: tensor 'encoder\.extra' has no place"):
        export_run(folder)


def test_a_run_whose_quantiser_has_not_started_is_refused(tmp_path: Path) -> None:
    model = (
        ConvolutionalEncoder(SPEC, features=8, channels=2, strides=[2]),
        VectorQuantiser(8, groups=2, codes=3, start_step=50),
    )
    write_model_description(tmp_path, *model, training={}, data={})
    write_checkpoint(tmp_path, 3, train_a_little(model))
    with pytest.raises(UserError, match=r"not started.*of 50 training steps"):
        export_run(tmp_path)


def test_a_description_that_cannot_be_written_is_one_line(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("x")
    encoder = ConvolutionalEncoder(SPEC, features=8, channels=2, strides=[2])
    with pytest.raises(UserError, match="cannot be written"):
        write_model_description(tmp_path / "file" / "run", encoder, Identity(8), training={}, data={})


@pytest.mark.parametrize("precision", [torch.bfloat16, torch.float64])
def test_a_run_of_another_precision_is_exported_as_float32(run: tuple[Path, Model, Model], precision: Any) -> None:
    folder, _, model = run
    write_checkpoint(folder, 9, (model[0].to(precision), model[1].to(precision)))
    frozen, observations = load_encoder(export_run(folder)), example_batch(SPEC, 6)
    assert {p.dtype for p in frozen.parameters()} == {torch.float32}
    assert frozen.description["training"]["steps"] == 9
    expected = latents((model[0].to(torch.float32), model[1].to(torch.float32)), observations)
    assert torch.equal(frozen.encode(observations), expected)


def test_damaged_checkpoints_alone_are_nothing_to_export(run: tuple[Path, Model, Model]) -> None:
    for path in (run[0] / "checkpoints").iterdir():
        path.write_bytes(path.read_bytes()[:-100])
    with pytest.raises(UserError, match="arm: all its checkpoints are damaged: nothing to export"):
        export_run(run[0])


def test_a_run_in_place_of_its_bundle_is_told(run: tuple[Path, Model, Model]) -> None:
    with pytest.raises(UserError, match=r"arm: is a run: export it \(.* export .*arm\)"):
        load_encoder(run[0])
    export_run(run[0])
    with pytest.raises(UserError, match=r"arm: is a run: name its bundle, .*arm/bundle"):
        load_encoder(run[0])


def test_formats_are_a_word_or_words_between_commas(run: tuple[Path, Model, Model], tmp_path: Path) -> None:
    assert (export_run(run[0], tmp_path / "p", formats="safetensors,pt2") / "model.pt2").is_file()
    for formats, words in (("pt3", "unknown export format 'pt3'.*pt2"), (",", "formats: expected a word")):
        with pytest.raises(UserError, match=words):
            export_run(run[0], tmp_path / "q", formats=formats)
    assert not (tmp_path / "q").exists()
