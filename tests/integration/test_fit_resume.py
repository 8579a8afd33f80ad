"""A fit killed and resumed through the command line gives the same losses, bit for bit, and the same weights."""

from __future__ import annotations

import csv
import signal
import sys
from pathlib import Path

import pytest
import torch

sys.path.insert(0, str(Path(__file__).parent))
from killing import command

from repdib_lightning.callbacks import last_good, read_status

STEPS = 13


def arguments(workers: int) -> list[str]:
    return [
        *("fit", "--data", "EpisodeDataModule", "--data.path", "small.h5", "--run", "run"),
        *("--data.batch_size", "4", "--data.horizon", "2", "--data.workers", str(workers)),
        *("--model.encoder.init_args.features", "16", "--model.bottleneck.init_args.start_step", "3"),
        *("--model.bottleneck.init_args.revive_after", "2", "--model.bottleneck.init_args.codes", "6"),
        *("--model.scheduler", "torch.optim.lr_scheduler.CosineAnnealingLR", "--model.scheduler.T_max", str(STEPS)),
        *("--trainer.max_steps", str(STEPS), "--trainer.val_check_interval", "2", "--trainer.log_every_n_steps", "1"),
        *("--checkpoint_every", "2", "--trainer.enable_progress_bar", "false"),
    ]


def curve(run: Path) -> list[dict[str, str]]:
    """metrics.csv, as text: equal text is equal to the last bit."""
    with open(run / "metrics.csv", newline="") as file:
        rows = list(csv.DictReader(file))
    return sorted(({k: v for k, v in row.items() if v} for row in rows), key=lambda row: (int(row["step"]), len(row)))


def weights(run: Path) -> dict[str, torch.Tensor]:
    return torch.load(last_good(run), weights_only=True)["state_dict"]


@pytest.fixture(scope="module")
def whole(tmp_path_factory, make_store):
    """A run that nothing interrupted."""
    folder = tmp_path_factory.mktemp("whole")
    make_store(folder / "small.h5")
    assert command(folder, *arguments(0)) == 0, (folder / "output.txt").read_text()
    return folder


# The small store has 18 training anchors, so 4 batches an epoch: 6 is inside an epoch, 8 at the end of one.
@pytest.mark.parametrize(("workers", "killed_after"), [(0, 3), (0, 6), (0, 8), (2, 6), (2, 8)])
def test_killed_and_resumed(whole, tmp_path, make_store, workers, killed_after):
    make_store(tmp_path / "small.h5")
    kill = ["--trainer.callbacks", "killing.KillAfter", "--trainer.callbacks.batches", str(killed_after)]
    assert command(tmp_path, *arguments(workers), *kill) == -signal.SIGKILL, (tmp_path / "output.txt").read_text()
    assert read_status(tmp_path / "run").state != "finished"
    code = command(tmp_path, "fit", "--resume", "run", "--trainer.callbacks", "null")
    assert code == 0, (tmp_path / "output.txt").read_text()
    assert read_status(tmp_path / "run").state == "finished"
    resumed, uninterrupted = curve(tmp_path / "run"), curve(whole / "run")
    assert len(resumed) == len(uninterrupted) > STEPS
    assert resumed == uninterrupted
    final, wanted = weights(tmp_path / "run"), weights(whole / "run")
    assert final.keys() == wanted.keys()
    assert all(torch.equal(final[key], wanted[key]) for key in wanted)


def test_more_steps_on_resume_are_honoured(whole, tmp_path):
    import shutil

    shutil.copytree(whole, tmp_path / "copy")
    folder = tmp_path / "copy"
    assert command(folder, "fit", "--resume", "run", "--trainer.max_steps", "15") == 0
    steps = [int(row["step"]) for row in curve(folder / "run") if "train/loss" in row]
    assert steps == list(range(15))
    assert curve(folder / "run")[: len(curve(whole / "run"))] == curve(whole / "run")


def test_two_fresh_runs_are_equal(whole, tmp_path, make_store):
    make_store(tmp_path / "small.h5")
    assert command(tmp_path, *arguments(2)) == 0
    assert curve(tmp_path / "run") == curve(whole / "run")


def test_the_scheduler_has_advanced_at_every_step(whole):
    """The cosine of T_max = all steps ends at zero."""
    state = torch.load(last_good(whole / "run"), weights_only=True)["optimizer_states"][0]
    assert state["param_groups"][0]["lr"] < 1e-8
