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

# Rounds of two episodes of 10 actions; 38 updates, before the 1st and the 21st of which episodes end.
LONG = [
    *("--checkpoint_every", "7", "--trainer.log_every_n_steps", "10", "--data.hold_out_every", "3"),
    *("--data.frame_stack", "2", "--data.action_repeat", "100", "--data.update_every", "1"),
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


@pytest.fixture
def here(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return tmp_path


def go_on(*options):
    assert main(["fit", "--resume", "run", "--trainer.callbacks", "null", "--trainer.max_steps", "-1", *options]) == 0
    assert read_status(Path("run")).state == "finished"


def test_killed_in_mid_episode_it_goes_on_as_if_nothing_had_been(whole, here):
    """Logs are written at steps 19 and 29, a checkpoint after 21, when episodes have just ended."""
    kill = ["--trainer.callbacks", "killing.KillAfter", "--trainer.callbacks.batches", "25"]
    assert command(here, *long(*kill)) == -signal.SIGKILL, Path("output.txt").read_text()
    assert not Path("run/replay.h5").exists() and last_good(Path("run")).name == "step-00000021.ckpt"
    go_on("--data.processes", "true")  # which make the same run
    equal(Path("run"), whole)


def end_by(name, when, batches=0):
    return [
        *("--trainer.callbacks", "ending.EndBy", "--trainer.callbacks.name", name),
        *("--trainer.callbacks.when", when, "--trainer.callbacks.batches", str(batches)),
    ]


def test_killed_between_the_last_checkpoint_and_the_end_of_the_replay(whole, here):
    assert command(here, *long(*end_by("SIGKILL", "fit_end"))) == -signal.SIGKILL, Path("output.txt").read_text()
    assert not Path("run/replay.h5").exists()
    go_on()
    equal(Path("run"), whole)


@pytest.mark.parametrize(("name", "when", "code"), [("SIGTERM", "acting", 143), ("SIGINT", "batch", 130)])
def test_asked_to_end_with_its_workers_it_goes_on_with_new_ones(whole, here, name, when, code):
    """Workers do not end by themselves, so that the update under way is made and checkpointed where that is asked."""
    found = command(here, *long("--data.processes", "true", *end_by(name, when, 25)))
    output = Path("output.txt").read_text()
    assert found == code and "Traceback" not in output and "stopped: run    go on:" in output, output
    assert last_good(Path("run")).name == ("step-00000026.ckpt" if name == "SIGTERM" else "step-00000021.ckpt")
    go_on()
    equal(Path("run"), whole)


def test_stopped_by_its_steps_it_goes_on_to_the_end(whole, here):
    assert main(long("--trainer.max_steps", "15")) == 0
    assert list(snapshots_of(Path("run"))) == [3000]
    go_on()
    equal(Path("run"), whole)


def test_a_finished_run_stays_as_it_is(whole, here):
    shutil.copytree(whole, "run")
    go_on()
    equal(Path("run"), whole)


def test_a_finished_run_that_lost_its_last_checkpoint_goes_on_from_the_one_before(whole, here):
    shutil.copytree(whole, "run")
    last = last_good(Path("run"))
    last.write_bytes(last.read_bytes()[:-100])
    go_on()
    equal(Path("run"), whole)


def test_what_a_run_cannot_do_is_one_line(whole, here, capsys):
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
