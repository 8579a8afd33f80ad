"""Recognition of activities from a store of clips to a bundle's classes, through the real entry point."""

from __future__ import annotations

import csv
import json
import re
import sys
from pathlib import Path

import pytest
import torch
import yaml

sys.path.insert(0, str(Path(__file__).parent))
sys.path.insert(0, str(Path(__file__).parents[1]))
from clip_stores import MODALITIES, write_clips
from killing import command, command_in_processes

from repdib_lightning.__main__ import main
from repdib_lightning.callbacks import last_good
from repdib_lightning.data.datamodule import EpisodeDataModule
from repdib_lightning.export import load_classifier, load_encoder

STEPS = 6
QUANTISED = {"groups": 2, "codes": 5, "start": "random", "start_step": 1}
HELD_OUT = {"subject": ["3", "4"]}
BASE = {
    "model": {
        "encoder": {
            "class_path": "MultimodalEncoder",
            "init_args": {
                "features": 16,
                "width": 8,
                "channels": 4,
                "dropout": 0.0,
                "segments": 2,
                "angles": ["orientation"],
                "bottleneck": "RepDIB",
                "bottleneck_options": QUANTISED,
            },
        },
        "bottleneck": {"class_path": "RepDIB", "init_args": QUANTISED},
        "objective": {
            "class_path": "Classification",
            "init_args": {
                "label_smoothing": 0.1,
                "classifier": {"class_path": "MLPClassifier", "init_args": {"hidden": 8, "dropout": 0.3}},
            },
        },
        # Plain gradient descent: Adam divides by the gradient's size, so that rounding grows into steps.
        "optimizer": {"class_path": "torch.optim.SGD", "init_args": {"lr": 0.02}},
        "scheduler": {
            "class_path": "torch.optim.lr_scheduler.CosineAnnealingWarmRestarts",
            "init_args": {"T_0": 1, "T_mult": 2},
        },
        "scheduler_interval": "epoch",
        "shift": 1,
    },
    "data": {
        "class_path": "EpisodeDataModule",
        "init_args": {"path": "clips.h5", "target": "activity", "held_out": HELD_OUT, "batch_size": 8, "futures": 0},
    },
    "trainer": {
        "max_steps": STEPS,
        "val_check_interval": 3,
        "check_val_every_n_epoch": None,
        "log_every_n_steps": 1,
        "enable_progress_bar": False,
        "accelerator": "cpu",
    },
    "checkpoint_every": 4,
}
FIT = ("fit", "--config", "base.yaml", "--run", "run")
KILL = ("--trainer.callbacks", "killing.KillAfter", "--trainer.callbacks.batches")
TWO = ("--trainer.devices", "2", "--trainer.strategy", "ddp")


def made(folder: Path, missing: bool = True) -> Path:
    folder.mkdir(exist_ok=True)
    write_clips(folder / "clips.h5", clips=53, size=8, missing=missing)
    (folder / "base.yaml").write_text(yaml.safe_dump(BASE))
    return folder


def curve(folder: Path) -> dict[tuple[int, str], float]:
    with open(folder / "run/metrics.csv", newline="") as file:
        rows = list(csv.DictReader(file))
    return {(int(row["step"]), key): float(value) for row in rows for key, value in row.items() if value}


def state(folder: Path) -> dict[str, torch.Tensor]:
    return torch.load(last_good(folder / "run"), weights_only=True)["state_dict"]


@pytest.fixture(scope="module")
def one(tmp_path_factory) -> Path:
    folder = made(tmp_path_factory.mktemp("alone"))
    assert command(folder, *FIT) == 0, (folder / "output.txt").read_text()
    return folder


def test_a_run_logs_the_scores_and_the_terms_of_every_modality(one):
    last = {key: value for (_, key), value in sorted(curve(one).items())}
    for stage in ("train", "val"):
        assert {f"{stage}/raw/unimodal_kl", f"{stage}/weighted/unimodal_commitment", f"{stage}/accuracy"} <= set(last)
    assert {"val/f1_macro", "val/f1_micro", "val/f1_weighted"} <= set(last)
    assert all(f"val/perplexity/{name}" in last for name in (*MODALITIES, "group_0"))
    assert last["val/f1_micro"] == pytest.approx(last["val/accuracy"])


def test_the_bundle_tells_the_same_classes_as_the_run(one, monkeypatch):
    monkeypatch.chdir(one)
    assert main(["export", "run", "--overwrite"]) == 0
    encoder, classifier = load_encoder("run/bundle"), load_classifier("run/bundle")
    assert (classifier.target, len(classifier.classes)) == ("activity", 3)
    assert json.loads(Path("run/bundle/config.json").read_text())["data"]["held_out"] == HELD_OUT
    data = EpisodeDataModule("clips.h5", futures=0, target="activity", held_out=HELD_OUT, batch_size=5)
    data.setup()
    right = []
    for batch in data.val_dataloader():
        clips = {name: array[:, 0] for name, array in batch.observations.items()}
        right.append(classifier(encoder.encode(clips)).argmax(1) == batch.targets)
        looked = encoder.detailed(clips)
        assert set(looked.codes) == set(MODALITIES) and torch.equal(looked.features, encoder.encode(clips))
    accuracy = max((step, value) for (step, key), value in curve(one).items() if key == "val/accuracy")[1]
    assert torch.cat(right).float().mean().item() == pytest.approx(accuracy)


@pytest.mark.parametrize("verb", ["validate", "test"])
def test_the_held_out_scores_can_be_asked_for_again(one, monkeypatch, capsys, verb):
    monkeypatch.chdir(one)
    assert main([verb, "run"]) == 0
    assert f"{'val' if verb == 'validate' else 'test'}/f1_macro" in capsys.readouterr().out


def test_killed_and_resumed_it_ends_with_the_same_bits(one, tmp_path):
    folder = made(tmp_path / "killed")
    assert command(folder, *FIT, *KILL, "5") < 0
    assert command(folder, "fit", "--resume", "run", *KILL, "-1") == 0, (folder / "output.txt").read_text()
    assert curve(folder) == curve(one)
    assert all(torch.equal(value, state(folder)[key]) for key, value in state(one).items())


def test_two_processes_train_and_score_as_one(tmp_path):
    """Nothing is missing: else some clips count twice in the codebooks of two, which share them out evenly."""
    first, second = made(tmp_path / "one", missing=False), made(tmp_path / "two", missing=False)
    assert command(first, *FIT) == 0, (first / "output.txt").read_text()
    assert command_in_processes(2, second, *FIT, *TWO) == [0, 0], (second / "output.txt").read_text()
    alone, together = curve(first), curve(second)
    held_out = [key for key in alone if key[1].startswith("val/")]
    assert {"val/f1_macro", "val/accuracy", "val/perplexity/cam1"} <= {name for _, name in held_out}
    for key in held_out:
        # The last bits of a distance may move one clip between two codes that are all but the same place.
        flip = 0.05 if re.search("perplexity|used", key[1]) else 1e-5
        assert together[key] == pytest.approx(alone[key], rel=2e-4, abs=flip), key
    for key, value in state(first).items():
        assert torch.allclose(state(second)[key], value, rtol=1e-4, atol=1e-5), key


@pytest.mark.parametrize(
    ("options", "complaint"),
    [
        (["--data.init_args.target", ""], "set data.target to a categorical factor"),
        (["--data.init_args.target", "actvity"], "did you mean 'activity'"),
        (["--model.objective.init_args.classifier", "MLPClasifier"], "did you mean 'MLPClassifier'"),
        (["--model.objective.init_args.classifier", "dropout"], "choices: LinearClassifier, MLPClassifier"),
        (["--model.objective.init_args.label_smothing", "0.1"], "did you mean 'label_smoothing'"),
        (["--model.scheduler_interval", "epochs"], "did you mean 'epoch'"),
        (["--model.loss_weights", "{unimodal_kll: 1.0}"], "did you mean 'unimodal_kl'"),
    ],
)
def test_a_mistake_is_one_line(tmp_path, monkeypatch, capsys, options, complaint):
    monkeypatch.chdir(made(tmp_path))
    assert main([*FIT, *options]) == 2
    error = capsys.readouterr().err.splitlines()[-1]
    assert error.startswith("error: ") and complaint in error, error
    assert not Path("run").exists()
