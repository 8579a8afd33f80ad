"""Bad input: one line on stderr that names what is wrong and the nearest choice, exit code 2, nothing written."""

from __future__ import annotations

import json
import os
import shutil
from pathlib import Path

import h5py
import numpy as np
import pytest

from repdib_lightning.__main__ import main

TRAIN = ["--data.batch_size", "8", "--trainer.max_steps", "4", "--trainer.enable_progress_bar", "false",
         "--trainer.val_check_interval", "2", "--model.bottleneck.init_args.start_step", "1",
         "--data.horizon", "3"]  # fmt: skip


@pytest.fixture
def here(tmp_path, monkeypatch, store_file):
    monkeypatch.chdir(tmp_path)
    return tmp_path


def complaint(capsys, *arguments: str) -> str:
    """Run a command that must fail; return its one line."""
    capsys.readouterr()
    before = tree(Path())
    assert main(list(arguments)) == 2
    error = capsys.readouterr().err.strip().splitlines()
    lines = [line for line in error if not line.startswith("Seed set")]
    assert len(lines) == 1, error
    assert tree(Path()) == before, "something was left behind"
    return lines[0]


def tree(folder: Path) -> dict[str, int]:
    return {str(path): path.stat().st_size for path in folder.rglob("*")}


def fit(*options: str) -> list[str]:
    return ["fit", "--data", "EpisodeDataModule", "--data.path", "small.h5", *TRAIN, *options]


@pytest.mark.parametrize(
    ("arguments", "wanted"),
    [
        (["fti"], "unknown verb 'fti', did you mean 'fit'?"),
        (["fit", "--config", "robot_amr"], "--config robot_amr: no such file or packaged configuration; did you mean"),
        (fit("--model.shfit", "1"), "unknown option --model.shfit, did you mean '--model.shift'?"),
        (fit("--trainer.max_epoch", "3"), "unknown option --trainer.max_epoch, did you mean '--trainer.max_epochs'?"),
        (fit("--model.encoder.init_args.featurs", "8"), "model.encoder.featurs, did you mean 'features'?"),
        (fit("--model.encoder.init_args.features", "many"), "model.encoder.features: expected int, got 'many'"),
        (fit("--data.init_args.batch_size", "x"), "data.batch_size: expected int, got 'x'"),
        (fit("--model.bottleneck", "RepDB"), "model.bottleneck: unknown class 'RepDB', did you mean 'RepDIB'?"),
        (fit("--model.bottleneck.init_args.groups", "7"), "groups 7 does not divide the width 128 (nearest: 4 or 8)"),
        (fit("--data.init_args.batch_size", "-3"), "data.batch_size must be at least 1, is -3"),
        (fit("--model.loss_weights", "{kll: 1.0}"), "no loss is called 'kll' in this run, did you mean 'kl'?"),
        (fit("--data.init_args.views", "[frnt]"), "small.h5: has no observation 'frnt', did you mean 'front'?"),
        (fit("--data.horizon", "30"), "episode 0 has 12 steps, fewer than the horizon 30"),
        (fit("--checkpoint_every", "0"), "checkpoint_every"),
        (fit("--data.batch_size", "1000"), "batch_size is 1000, the data has"),
        (fit("--model.optimizer.lr", "-1"), "Invalid learning rate"),
        (fit("--model.encoder.strides", "[0]"), "strides ([0]) must be at least 1"),
        (fit("--model.encoder.views", "[]"), "needs at least one picture"),
        (["collect", "atari", "x.h5", "--mixture", "a:0.5"], "mixture: expected pairs '{str: float}', got 'a:0.5'"),
        (["collect", "atari", "x.h5", "--mixture", "{random: inf}"], "mixture: must be a finite number, is inf"),
        (["finetune", "dt", "--data", "x.h5", "--target_return", "nan"], "target_return: must be a finite number"),
        (fit("--seed_everything", "-1"), "seed_everything"),
        (fit("--trainer.accelerator", "gpu"), "No supported gpu backend found"),
        (fit("--trainer.max_steps", "0"), "trainer.max_steps is 0: no step would be trained"),
        (fit("--trainer.fast_dev_run", "true"), "use --config debug"),
        (fit("--trainer.default_root_dir", "x"), "--run"),
        (fit("--trainer.overfit_batches", "2"), "overfit_batches"),
        (fit("--trainer.check_val_every_n_epoch", "1", "--trainer.val_check_interval", "900"), "val_check_interval"),
        (fit("--run", ""), "--run: needs the name of a folder"),
        (["fit", "--resume", "runs/none"], "runs/none: no such run"),
        (["fit", "--resume"], "--resume: needs the folder of a run"),
        (["validate"], "validate: needs the folder of a run"),
        (["collect", "robot_amr", "x.h5"], "collect: unknown environment 'robot_amr', did you mean 'robot_arm'?"),
        (["collect", "robot_arm", "x.h5", "--samples", "-5"], "samples"),
        (["collect", "robot_arm", "small.h5"], "small.h5: exists already"),
        (["import", "vdrl", "a", "b"], "import: unknown format 'vdrl', did you mean 'vd4rl'?"),
        (["import", "vd4rl", "nowhere", "b.h5"], "nowhere"),
        (["inspect", "smal.h5"], "smal.h5: no such"),
        (["export", "runs/none"], "runs/none: no such run folder"),
        (["probe", "nowhere", "small.h5"], "nowhere"),
        (["probe", "nowhere"], "data"),
        (["compare", "small.h5", "out.html", "nowhere"], "nowhere"),
        (["compare"], "compare: the following arguments are required: data, output, runs"),
        (["compare", "small.h5", "out.html", "a", "--sed", "1"], "compare: unrecognized arguments: --sed"),
        (["compare", "small.h5", "out.html", "a", "--seed", "x"], "compare: argument --seed: invalid int value"),
        (["compare", "nowhere", "small.h5", "a"], "OUTPUT must end in .html, is 'small.h5'"),
        (["compare", "small.h5", "out.html", "a", "--probes", "linaer"], "did you mean 'linear'?"),
        (["inspect", "small.h5", "--contact_sheet", "small.h5"], "--contact_sheet must end in .png"),
        (["probe", "nowhere", "small.h5", "--seed", "-1"], "seed must be at least 0"),
    ],
)  # fmt: skip
def test_one_line(here, capsys, arguments, wanted):
    assert wanted in complaint(capsys, *arguments)


def test_yaml_with_an_unknown_key_and_broken_yaml(here, capsys):
    Path("typo.yaml").write_text("model:\n  shfit: 3\n")
    assert "unknown key model.shfit, did you mean 'shift'?" in complaint(
        capsys, "fit", "--config", "robot_arm", "--config", "typo.yaml"
    )
    Path("broken.yaml").write_text("model: [\n")
    assert "broken.yaml" in complaint(capsys, "fit", "--config", "broken.yaml")


def test_data_files(here, capsys, make_store):
    whole = Path("small.h5").read_bytes()
    for content, wanted in (
        (whole[: len(whole) // 3], "small.h5: truncated"),
        (b"no HDF5", "not a readable HDF5 file"),
    ):
        Path("small.h5").write_bytes(content)
        assert wanted in complaint(capsys, *fit())
    Path("small.h5").unlink()
    assert "small.h5: no such data file" in complaint(capsys, *fit())
    make_store(Path("small.h5"), kind=None)
    assert "predicts actions, but the data has none" in complaint(capsys, *fit())
    Path("small.h5").unlink()
    make_store(Path("small.h5"), kind="continuous")
    with h5py.File("small.h5", "r+") as file:
        file["actions"][4, 0] = np.nan
    assert "'actions' is not finite" in complaint(capsys, *fit())
    with h5py.File("small.h5", "r+") as file:
        del file["actions"]
        file["actions"] = np.zeros((7, 2), np.float32)
    assert "'actions' has 7 rows" in complaint(capsys, *fit())


def test_run_folders(here, capsys):
    Path("taken").mkdir()
    Path("taken/notes.txt").write_text("mine")
    assert "taken: exists already; choose another --run" in complaint(capsys, *fit("--run", "taken"))
    Path("file").touch()
    assert "file: is a file" in complaint(capsys, *fit("--run", "file"))
    assert "cannot be written" in complaint(capsys, *fit("--run", "/proc/nowhere/run"))
    assert "cannot be written" in complaint(capsys, "collect", "robot_arm", "/proc/nowhere/x.h5", "--samples", "10")


@pytest.fixture(scope="module")
def trained(tmp_path_factory, make_store):
    """A folder with a data set and one short, exported run."""
    folder = tmp_path_factory.mktemp("trained")
    before = os.getcwd()
    os.chdir(folder)
    make_store(Path("small.h5"))
    assert main(fit("--run", "runs/a")) == 0
    assert main(["export", "runs/a"]) == 0
    os.chdir(before)
    return folder


@pytest.fixture
def copy(trained, tmp_path, monkeypatch):
    shutil.copytree(trained, tmp_path / "copy")
    monkeypatch.chdir(tmp_path / "copy")
    return tmp_path / "copy"


def test_checkpoints(copy, capsys):
    newest = sorted(Path("runs/a/checkpoints").glob("*.ckpt"))
    for path in newest:
        path.write_bytes(path.read_bytes()[:-100])
    assert "runs/a" in complaint(capsys, "fit", "--resume", "runs/a", "--trainer.max_steps", "6")
    for path in newest:
        path.unlink()
    assert "runs/a" in complaint(capsys, "validate", "runs/a")


@pytest.mark.parametrize(
    ("options", "wanted"),
    [
        (["--data.batch_size", "16"], "data.init_args.batch_size was 8 and is 16 now"),
        (["--model.bottleneck.init_args.groups", "16"], "groups was 8 and is 16 now"),
        (["--model.optimizer.init_args.lr", "0.5"], "lr was 0.001 and is 0.5 now"),
        (["--seed_everything", "7"], "seed_everything was 0 and is 7 now"),
        (["--data.path", "other.h5"], "other.h5 holds other data"),
        (["--run", "runs/b"], "leave out --run"),
    ],
)
def test_a_run_keeps_its_model_and_data(copy, capsys, make_store, options, wanted):
    make_store(Path("other.h5"), seed=9)
    assert wanted in complaint(capsys, "fit", "--resume", "runs/a", "--trainer.max_steps", "9", *options)
    assert main(["fit", "--resume", "runs/a", "--trainer.max_steps", "6"]) == 0, "the run is as good as before"


def test_a_finished_run_has_nothing_to_resume(copy, capsys):
    before = tree(Path())
    assert main(["fit", "--resume", "runs/a"]) == 0
    assert "is at step 4 already" in capsys.readouterr().out and tree(Path()) == before


def test_a_run_in_training_is_not_resumed_twice(copy, capsys):
    from repdib_lightning.callbacks.status_file import Status

    Status.of_this_process().write(Path("runs/a"))
    assert "is training this run" in complaint(capsys, "fit", "--resume", "runs/a", "--trainer.max_steps", "9")


def test_a_resumed_run_does_not_collect_data(copy, capsys):
    Path("small.h5").unlink()
    assert "small.h5: no such data file" in complaint(capsys, "fit", "--resume", "runs/a", "--trainer.max_steps", "9")


def test_a_run_stands_for_its_bundle(copy, capsys):
    make = ["--probes", "linear", "--progress", "false"]
    assert main(["probe", "runs/a", "small.h5", *make]) == 0
    assert json.loads(Path("runs/a/bundle/probe.json").read_text())["name"] == "a"
    assert "--output must end in .json" in complaint(capsys, "probe", "runs/a", "small.h5", "--output", "small.h5")
    assert "formats: expected" in complaint(capsys, "export", "runs/a", "--output", "x", "--formats", ",")
    assert main(["export", "runs/a", "--output", "pt", "--formats", "pt2"]) == 0
    assert Path("pt/model.pt2").is_file()
    pair = ["runs/a", "again=runs/a"]
    assert main(["compare", "small.h5", "out.html", *pair, "--probes", "linear", "--device", "cpu", "--seed", "2"]) == 0
    written = json.loads(Path("out.json").read_text())
    assert list(written) == ["a", "again"] and written["again"]["seed"] == 2


def test_bundles(copy, capsys, make_store):
    make_store(Path("large.h5"), size=28)
    assert "front" in complaint(capsys, "probe", "runs/a/bundle", "large.h5")
    assert "runs/a/bundle: exists" in complaint(capsys, "export", "runs/a")
    weights = Path("runs/a/bundle/model.safetensors")
    flipped = bytearray(weights.read_bytes())
    flipped[-5] ^= 1
    weights.write_bytes(flipped)
    assert "model.safetensors" in complaint(capsys, "probe", "runs/a/bundle", "small.h5")
    config = Path("runs/a/bundle/config.json")
    newer = json.loads(config.read_text()) | {"schema_version": 99}
    config.write_text(json.dumps(newer))
    assert "99" in complaint(capsys, "probe", "runs/a/bundle", "small.h5")


def test_a_loss_that_is_not_finite_stops_and_keeps_the_last_good_checkpoint(here, capsys):
    assert main(fit("--run", "runs/n", "--model.optimizer.init_args.lr", "1e30", "--checkpoint_every", "1")) == 2
    error = capsys.readouterr().err
    assert "not finite" in error and "step" in error and "Traceback" not in error
    status = json.loads(Path("runs/n/status.json").read_text())
    assert status["state"] == "failed"
    from repdib_lightning.callbacks import last_good

    assert last_good(Path("runs/n")).is_file()
