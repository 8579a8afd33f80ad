"""A bundle with a classifier: the same classes before and after, and whatever happens to it is one line."""

from __future__ import annotations

import json
import shutil
import sys
from pathlib import Path

import pytest
import torch

sys.path.insert(0, str(Path(__file__).parents[2]))
from clip_encoders import TOLD, PlainClips

from repdib_lightning import encoders
from repdib_lightning.bottlenecks import Identity, RepDIB
from repdib_lightning.callbacks.checkpoint_files import step_path
from repdib_lightning.callbacks.checkpoint_io import AtomicCheckpointIO
from repdib_lightning.classifiers import LinearClassifier, MLPClassifier
from repdib_lightning.encoders import ConvolutionalEncoder
from repdib_lightning.errors import UserError
from repdib_lightning.export import export_run, load_classifier, load_encoder, save_bundle, write_model_description
from repdib_lightning.export.description import sealed
from repdib_lightning.export.formats import example_batch
from repdib_lightning.records import ArraySpec, DataSpec

CLASSES = ("run", "sit", "walk")
READINGS = {name: ArraySpec((5, 6), "float32", (0.5,) * 6, (2.0,) * 6) for name in TOLD}
SPEC = DataSpec(READINGS, horizon=0, target="activity", classes=CLASSES)


@pytest.fixture(autouse=True)
def _listed(monkeypatch):
    monkeypatch.setitem(encoders.ENCODERS, "PlainClips", PlainClips)


def parts():
    torch.manual_seed(0)
    encoder = PlainClips(SPEC, features=8).train()
    encoder(example_batch(SPEC, 20))
    bottleneck = RepDIB(8, groups=2, codes=4, start="random", start_step=0)
    return encoder.eval(), bottleneck.eval(), MLPClassifier(SPEC, 8, hidden=6, dropout=0.5).eval()


def save(folder, **options):
    encoder, bottleneck, classifier = parts()
    facts = {"file": "clips.h5", "held_out": {"subject": ["3", "4"]}}
    save_bundle(folder, encoder, bottleneck, training={}, data=facts, classifier=classifier, **options)
    return encoder, bottleneck, classifier


@pytest.fixture(scope="module")
def intact(tmp_path_factory):
    folder = tmp_path_factory.mktemp("bundles") / "intact"
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(encoders.ENCODERS, "PlainClips", PlainClips)
        save(folder)
    return folder


@pytest.fixture
def bundle(intact, tmp_path):
    return Path(shutil.copytree(intact, tmp_path / "bundle"))


def test_the_same_classes_of_the_same_names(intact):
    encoder, bottleneck, classifier = parts()
    frozen, loaded = load_encoder(intact), load_classifier(intact)
    seen = example_batch(SPEC, 6)
    seen["gyroscope"][2] = torch.nan
    with torch.no_grad():
        wanted = classifier(bottleneck(encoder(seen)).latent)
    assert torch.equal(loaded(frozen.encode(seen)), wanted) and wanted.shape == (6, 3)
    assert (loaded.target, loaded.classes) == ("activity", CLASSES)
    assert not loaded.training and not any(parameter.requires_grad for parameter in loaded.parameters())
    assert frozen.spec == SPEC
    assert frozen.description["data"] == {"file": "clips.h5", "held_out": {"subject": ["3", "4"]}}


def test_what_is_inside_an_encoder_can_be_looked_at(intact):
    encoder, _, _ = parts()
    frozen, seen = load_encoder(intact), example_batch(SPEC, 6)
    seen["gyroscope"][2] = torch.nan
    found = frozen.detailed(seen)
    with torch.no_grad():
        inside = encoder.detailed(seen)
    assert torch.equal(found.features, frozen.encode(seen)) and not found.features.requires_grad
    assert set(found.codes) == set(TOLD)
    assert all(torch.equal(found.codes[name], inside.codes[name]) for name in TOLD)
    assert torch.equal(found.attention["modalities"], inside.attention["modalities"])
    assert found.attention["modalities"][2].tolist() == [1.0, 0.0] and found.losses == {}
    one = frozen.detailed({name: array[2] for name, array in seen.items()})
    assert one.features.shape == (8,) and one.codes["gyroscope"].shape == (2,)
    assert one.attention["modalities"].tolist() == [1.0, 0.0]
    assert frozen.detailed({name: array[:0] for name, array in seen.items()}).features.shape == (0, 8)


def test_a_run_is_exported_with_its_classifier(tmp_path):
    encoder, bottleneck, classifier = parts()
    facts = {"training": {}, "data": {"held_out": {"subject": ["4"]}}}
    heads = {"classifier": ("parts.1.classifier", classifier)}
    write_model_description(tmp_path / "run", encoder, bottleneck, **facts, heads=heads)
    modules = {"encoder": encoder, "bottleneck": bottleneck, "objective.parts.1.classifier": classifier}
    state = {f"{place}.{name}": value for place, part in modules.items() for name, value in part.state_dict().items()}
    checkpoint = step_path(tmp_path / "run" / "checkpoints", 3)
    checkpoint.parent.mkdir()
    AtomicCheckpointIO().save_checkpoint({"state_dict": state, "global_step": 3}, checkpoint)
    folder = export_run(tmp_path / "run")
    latents = torch.randn(5, 8)
    with torch.no_grad():
        assert torch.equal(load_classifier(folder)(latents), classifier(latents))
    assert load_encoder(folder).description["data"] == facts["data"]


def test_a_bundle_without_a_classifier_says_so(tmp_path):
    spec = DataSpec({"pixels": ArraySpec((3, 16, 16))}, horizon=0)
    encoder = ConvolutionalEncoder(spec, features=4, channels=2, strides=[2]).eval()
    save_bundle(tmp_path / "bundle", encoder, Identity(4), training={}, data={})
    with pytest.raises(UserError, match=r"config\.json: has no classifier; only an objective that recognises a factor"):
        load_classifier(tmp_path / "bundle")


@pytest.mark.parametrize("damage", ["gone", "cut", "swapped"])
def test_damaged_weights_are_told(bundle, damage):
    weights = bundle / "model.classifier.safetensors"
    content = weights.read_bytes()
    weights.unlink()
    if damage != "gone":
        weights.write_bytes(content[:-8] if damage == "cut" else (bundle / "model.safetensors").read_bytes())
    with pytest.raises(UserError, match=r"model\.classifier\.safetensors: (no such file|content does not match)"):
        load_classifier(bundle)
    load_encoder(bundle)  # which needs no classifier


@pytest.mark.parametrize(
    ("change", "complaint"),
    [
        (lambda c: c.update(classifier="linear"), "'classifier' must be a map"),
        (lambda c: c["classifier"].update({"class": "MLPClasifier"}), "did you mean 'MLPClassifier'"),
        (lambda c: c["classifier"].update({"class": "ResidualDecoder"}), "'classifier.class' is unknown"),
        (lambda c: c["classifier"]["arguments"].update(hiden=3), "'hiden', unknown to MLPClassifier; did you mean"),
        (lambda c: c["classifier"]["arguments"].update(hidden=7), "has shape .*, config.json asks for"),
        (lambda c: c["classifier"]["arguments"].update(hidden=0), "do not build a MLPClassifier: .*hidden must be"),
        (lambda c: c["spec"].update(target=""), "do not build a MLPClassifier: .*nothing is to be recognised"),
        (lambda c: c["spec"].update(classes=["run", "sit"]), "has shape .*, config.json asks for"),
        (lambda c: c["spec"].update(classes="run"), "'spec.classes' a list of names"),
        (lambda c: c["files"].pop("model.classifier.safetensors"), "'files.model.classifier.safetensors' is missing"),
    ],
)
def test_wrong_but_sealed_content_is_one_line(bundle, change, complaint):
    config = json.loads((bundle / "config.json").read_text())
    change(config)
    (bundle / "config.json").write_text(json.dumps(sealed(config)))
    with pytest.raises(UserError, match=complaint) as told:
        load_classifier(bundle)
    assert "\n" not in str(told.value)


def test_what_is_not_finite_or_not_ready_is_not_exported(tmp_path):
    encoder, bottleneck, classifier = parts()
    classifier.layers[1].bias.data[0] = float("inf")
    with pytest.raises(UserError, match=r"MLPClassifier: parameter 'layers\.1\.bias' is not finite"):
        save_bundle(tmp_path / "bundle", encoder, bottleneck, training={}, data={}, classifier=classifier)
    with pytest.raises(UserError, match="PlainClips: is not ready"):
        save_bundle(tmp_path / "bundle", PlainClips(SPEC, features=8, ready=False), bottleneck, training={}, data={})
    assert not (tmp_path / "bundle").exists()


def test_a_bundle_is_replaced_with_and_without_a_classifier(tmp_path):
    encoder, bottleneck, _ = save(tmp_path / "bundle")
    (tmp_path / "bundle/probe.json").write_text("{}")
    other = LinearClassifier(SPEC, 8)
    options = {"training": {}, "data": {}, "overwrite": True}
    save_bundle(tmp_path / "bundle", encoder, bottleneck, classifier=other, **options)
    assert type(load_classifier(tmp_path / "bundle")) is LinearClassifier
    save_bundle(tmp_path / "bundle", encoder, bottleneck, **options)
    assert "classifier" not in json.loads((tmp_path / "bundle/config.json").read_text())
    assert {file.name for file in (tmp_path / "bundle").iterdir()} == {"config.json", "model.safetensors"}
