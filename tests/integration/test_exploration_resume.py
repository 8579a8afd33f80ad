"""An exploration that is cut off anywhere goes on to the same metrics, replay, snapshots and weights, bit for bit."""

from __future__ import annotations

import json
import shutil
import signal
import sys
from pathlib import Path

import pytest
import torch

sys.path.insert(0, str(Path(__file__).parent))
from killing import command
from small_exploration import complaint, fit

from repdib_lightning.__main__ import main
from repdib_lightning.callbacks import last_good, read_status
from repdib_lightning.rl.exploration.snapshots import snapshots_of

# Rounds of two episodes of 20 actions; 39 updates, before the 1st and the 21st of which episodes end.
LONG = [
    *("--checkpoint_every", "7", "--trainer.log_every_n_steps", "10", "--data.hold_out_every", "3"),
    *("--data.frame_stack", "2"),
]


def long(*more):
    return fit("run", 6000, "[3000,5000,6000]", *LONG, *more)


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """A run that nothing interrupted."""
    folder = tmp_path_factory.mktemp("whole")
    assert command(folder, *long()) == 0, (folder / "output.txt").read_text()
    return folder / "run"


def equal(run, whole):
    """Byte for byte, but for times, and what checkpoints say of their own files."""
    assert (run / "metrics.csv").read_text() == (whole / "metrics.csv").read_text()
    assert (run / "replay.h5").read_bytes() == (whole / "replay.h5").read_bytes()
    assert list(snapshots_of(run)) == list(snapshots_of(whole))
    for mine, theirs in zip(snapshots_of(run).values(), snapshots_of(whole).values(), strict=True):
        assert (mine / "model.safetensors").read_bytes() == (theirs / "model.safetensors").read_bytes(), mine
        assert (mine / "agent.safetensors").read_bytes() == (theirs / "agent.safetensors").read_bytes(), mine
        configs = [json.loads((folder / "config.json").read_text()) for folder in (mine, theirs)]
        assert configs[0]["files"] == configs[1]["files"] and configs[0]["training"] == configs[1]["training"]
    final, wanted = (torch.load(last_good(folder), weights_only=True)["state_dict"] for folder in (run, whole))
    assert all(torch.equal(final[key], wanted[key]) for key in wanted) and final.keys() == wanted.keys()


@pytest.mark.parametrize("killed_after", [9, 25])
def test_killed_and_resumed_is_as_if_nothing_had_been(whole, tmp_path, killed_after):
    kill = ["--trainer.callbacks", "killing.KillAfter", "--trainer.callbacks.batches", str(killed_after)]
    assert command(tmp_path, *long(*kill)) == -signal.SIGKILL, (tmp_path / "output.txt").read_text()
    assert not (tmp_path / "run" / "replay.h5").exists()
    code = command(tmp_path, "fit", "--resume", "run", "--trainer.callbacks", "null")
    assert code == 0, (tmp_path / "output.txt").read_text()
    equal(tmp_path / "run", whole)
    assert read_status(tmp_path / "run").state == "finished"


def end_by(name, when, batches=0):
    return [
        *("--trainer.callbacks", "ending.EndBy", "--trainer.callbacks.name", name),
        *("--trainer.callbacks.when", when, "--trainer.callbacks.batches", str(batches)),
    ]


def test_killed_between_the_last_checkpoint_and_the_end_of_the_replay(whole, tmp_path):
    assert command(tmp_path, *long(*end_by("SIGKILL", "fit_end"))) == -signal.SIGKILL
    assert not (tmp_path / "run" / "replay.h5").exists()
    assert command(tmp_path, "fit", "--resume", "run", "--trainer.callbacks", "null") == 0
    equal(tmp_path / "run", whole)


@pytest.mark.parametrize(("name", "when", "code"), [("SIGTERM", "acting", 143), ("SIGINT", "batch", 130)])
def test_asked_to_end_with_its_workers_it_goes_on_without_them(whole, tmp_path, name, when, code):
    assert command(tmp_path, *long("--data.processes", "true", *end_by(name, when, 25))) == code
    output = (tmp_path / "output.txt").read_text()
    assert "Traceback" not in output and "stopped: run    go on:" in output
    assert last_good(tmp_path / "run").name == ("step-00000025.ckpt" if name == "SIGTERM" else "step-00000021.ckpt")
    assert command(tmp_path, "fit", "--resume", "run", "--trainer.callbacks", "null") == 0, output
    equal(tmp_path / "run", whole)


def test_stopped_by_its_steps_it_goes_on_to_the_end(whole, tmp_path):
    assert command(tmp_path, *long("--trainer.max_steps", "15")) == 0
    assert list(snapshots_of(tmp_path / "run")) == [3000]
    assert command(tmp_path, "fit", "--resume", "run", "--trainer.max_steps", "-1") == 0
    equal(tmp_path / "run", whole)


def test_a_finished_run_stays_as_it_is(whole, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    shutil.copytree(whole, "run")
    assert main(["fit", "--resume", "run"]) == 0
    equal(Path("run"), whole)
    assert read_status(Path("run")).state == "finished"


def test_a_finished_run_that_lost_its_last_checkpoint_goes_on_from_the_one_before(whole, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    shutil.copytree(whole, "run")
    last = last_good(Path("run"))
    last.write_bytes(last.read_bytes()[:-100])
    assert main(["fit", "--resume", "run"]) == 0
    equal(Path("run"), whole)


def test_what_a_run_cannot_do_is_one_line(whole, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    shutil.copytree(whole, "run")
    for verb in ("validate", "test"):
        assert f"{verb} run: an exploration has no held-out losses; export it" in complaint(capsys, verb, "run")
    changes = (
        ("data.frames", "9000", "6000"),
        ("data.task", "walker-run", "walker-stand"),
        ("model.hidden", "8", "16"),
    )
    for option, value, was in changes:
        said = complaint(capsys, "fit", "--resume", "run", f"--{option}", value)
        assert f"{option.replace('data.', 'data.init_args.')} was {was} and is {value} now" in said
    (Path("run") / "notes").mkdir()
    assert "run: exists already" in complaint(capsys, *long())
