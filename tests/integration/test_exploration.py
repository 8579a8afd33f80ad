"""Explorations through the command line: every domain to its end, killed and resumed, broken, and told wrong."""

from __future__ import annotations

import csv
import json
import shutil
import signal
import sys
from pathlib import Path

import numpy as np
import pytest
import torch

sys.path.insert(0, str(Path(__file__).parent))
from killing import command

from repdib_lightning.__main__ import main
from repdib_lightning.callbacks import last_good, read_status
from repdib_lightning.data.episodes import EpisodeStore
from repdib_lightning.data.fingerprint import recompute_fingerprint
from repdib_lightning.export import load_encoder
from repdib_lightning.rl.exploration.snapshots import find_snapshot, read_agent, snapshots_of

SIDE, REPEAT = 32, 50
TINY = [
    *("--config", "urlb/walker_repdib", "--trainer.enable_progress_bar", "false", "--model.hidden", "16"),
    *("--model.encoder.init_args.features", "16", "--model.bottleneck.init_args.start_step", "3"),
    *("--model.bottleneck.init_args.groups", "4", "--model.bottleneck.init_args.codes", "6"),
    *("--data.processes", "false", "--data.batch_size", "8", "--data.image_size", str(SIDE)),
    *("--data.seed_frames", "0", "--data.action_repeat", str(REPEAT)),
]


def fit(run, frames, snapshots, *more):
    return ["fit", *TINY, "--run", str(run), "--data.frames", str(frames), "--data.snapshots", str(snapshots), *more]


@pytest.fixture
def here(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return tmp_path


def rows(run):
    with open(Path(run) / "metrics.csv", newline="") as file:
        return list(csv.DictReader(file))


# Rounds of two episodes of 20 actions; 59 updates, before the 1st and after the 21st and 41st of which episodes end.
LONG = [
    *("--checkpoint_every", "7", "--trainer.log_every_n_steps", "10", "--data.hold_out_every", "3"),
    *("--data.frame_stack", "2"),
]


def long(*more):
    return fit("run", 8000, "[3000,6000,8000]", *LONG, *more)


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


@pytest.mark.parametrize("killed_after", [9, 25, 59])
def test_killed_and_resumed_is_as_if_nothing_had_been(whole, tmp_path, killed_after):
    kill = ["--trainer.callbacks", "killing.KillAfter", "--trainer.callbacks.batches", str(killed_after)]
    assert command(tmp_path, *long(*kill)) == -signal.SIGKILL, (tmp_path / "output.txt").read_text()
    assert not (tmp_path / "run" / "replay.h5").exists()
    snapshots = {path: path.stat().st_mtime_ns for path in snapshots_of(tmp_path / "run").values()}
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
