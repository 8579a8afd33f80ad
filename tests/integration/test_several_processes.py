"""Two processes train as one would: the same samples, the same codebook, the same losses, and exact resumption."""

from __future__ import annotations

import csv
import os
import subprocess
import sys
from pathlib import Path

import pytest
import torch

sys.path.insert(0, str(Path(__file__).parent))
from killing import command, command_in_processes

from repdib_lightning.callbacks import last_good, read_status

STEPS = 11
STOPPED = 5


def arguments(*more: str) -> list[str]:
    # Plain gradient descent: Adam divides by the gradient's size, so that rounding grows into steps.
    return [
        *("fit", "--data", "EpisodeDataModule", "--data.path", "small.h5", "--run", "run"),
        *("--data.batch_size", "8", "--data.horizon", "2", "--model.encoder.init_args.features", "16"),
        *("--model.bottleneck.init_args.start_step", "3", "--model.bottleneck.init_args.revive_after", "2"),
        *("--model.bottleneck.init_args.codes", "6", "--model.bottleneck.init_args.decay", "0.8"),
        *("--model.bottleneck.init_args.bypass", "0.3"),
        *("--model.optimizer", "torch.optim.SGD", "--model.optimizer.lr", "0.02"),
        *("--trainer.max_steps", str(STEPS), "--trainer.val_check_interval", "2", "--trainer.log_every_n_steps", "1"),
        *("--checkpoint_every", str(STOPPED), "--trainer.enable_progress_bar", "false", "--trainer.accelerator", "cpu"),
        *("--trainer.callbacks", "watching.Watch", "--trainer.callbacks.folder", ".", *more),
    ]


TWO = ("--trainer.devices", "2", "--trainer.strategy", "ddp")


def made(folder: Path, make_store) -> Path:
    folder.mkdir()
    make_store(folder / "small.h5", lengths=(13, 9, 11, 12, 14), evaluation=(2, 3))
    return folder


def curve(folder: Path) -> dict[tuple[int, str], float]:
    with open(folder / "run/metrics.csv", newline="") as file:
        rows = list(csv.DictReader(file))
    return {(int(row["step"]), key): float(value) for row in rows for key, value in row.items() if value}


def seen(folder: Path, processes: int) -> list[dict]:
    return [torch.load(folder / f"seen.{rank}.pt", weights_only=True) for rank in range(processes)]


@pytest.fixture(scope="module")
def one(tmp_path_factory, make_store) -> Path:
    folder = made(tmp_path_factory.mktemp("single") / "one", make_store)
    assert command(folder, *arguments()) == 0, (folder / "output.txt").read_text()
    return folder


@pytest.fixture(scope="module")
def two(tmp_path_factory, make_store) -> Path:
    folder = made(tmp_path_factory.mktemp("double") / "two", make_store)
    assert command_in_processes(2, folder, *arguments(*TWO)) == [0, 0], (folder / "output.txt").read_text()
    return folder


def test_together_they_see_what_one_process_sees(one, two):
    (alone,), both = seen(one, 1), seen(two, 2)
    steps = alone["rows"]["train"]
    assert len(steps) == STEPS
    for step, rows in enumerate(steps):
        shares = [process["rows"]["train"][step] for process in both]
        assert [len(share) for share in shares] == [4, 4]
        assert torch.equal(torch.cat(shares), rows)


def test_the_processes_end_with_the_same_state(two):
    first, second = (process["state"] for process in seen(two, 2))
    assert first["bottleneck.quantiser.started"]
    assert first.keys() == second.keys()
    for key, value in first.items():
        assert torch.equal(value, second[key]), key


def test_that_state_is_the_one_of_a_single_process(one, two):
    """Noise, shifts, k-means start, running sums, revived codes: all of it."""
    (alone,), (first, _) = seen(one, 1), seen(two, 2)
    assert (alone["state"]["bottleneck.quantiser.book.idle"] > 0).any()
    for key, value in alone["state"].items():
        assert torch.allclose(first["state"][key], value, rtol=1e-5, atol=1e-5), key


def test_evaluation_counts_no_sample_twice(one, two):
    (alone,), both = seen(one, 1), seen(two, 2)
    stages = [stage for stage in alone["rows"] if stage.startswith("validation")]
    assert len(stages) == STEPS // 2
    for stage in stages:
        wanted = torch.cat(alone["rows"][stage]).sort().values
        assert len(wanted.unique()) == len(wanted)
        counted = torch.cat([rows for process in both for rows in process["rows"][stage]])
        assert torch.equal(counted.sort().values, wanted)


def test_held_out_losses_are_those_of_a_single_process(one, two):
    """Also with an uneven number of samples: the mean is over samples, not over processes."""
    alone, together = curve(one), curve(two)
    held_out = [
        key for key in alone if key[1].startswith(("val/loss", "val/raw", "val/used/", "val/perplexity/", "val/action"))
    ]
    assert len(held_out) > 4 * STEPS // 2
    assert any("group_" in name for _, name in held_out)
    for key in held_out:
        assert together[key] == pytest.approx(alone[key], rel=2e-4, abs=1e-5), key


def test_resumed_at_the_same_number_of_processes(two, tmp_path, make_store):
    folder = made(tmp_path / "resumed", make_store)
    short = arguments(*TWO, "--trainer.max_steps", str(STOPPED))
    assert command_in_processes(2, folder, *short) == [0, 0], (folder / "output.txt").read_text()
    again = ("fit", "--resume", "run", "--trainer.max_steps", str(STEPS))
    assert command_in_processes(2, folder, *again) == [0, 0], (folder / "output.txt").read_text()
    assert read_status(folder / "run").state == "finished"
    for resumed, uninterrupted in zip(seen(folder, 2), seen(two, 2), strict=True):
        for key, value in uninterrupted["state"].items():
            assert torch.equal(resumed["state"][key], value), key
    assert curve(folder) == curve(two)


def test_another_number_of_processes_is_refused(two):
    code = command(two, "fit", "--resume", "run", "--trainer.devices", "1", "--trainer.max_steps", "20")
    assert code == 2
    assert "written by 2 processes, this run has 1" in (two / "output.txt").read_text()


LIGHTNING = [sys.executable, "-m", "repdib_lightning"]
TORCHRUN = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc_per_node", "2", "-m", "--"]


@pytest.mark.parametrize("launch", [LIGHTNING, [*TORCHRUN, "repdib_lightning"]], ids=["lightning", "torchrun"])
def test_the_commands_of_the_readme(two, tmp_path, make_store, launch):
    """Lightning's first process starts the second; torchrun starts both."""
    folder = made(tmp_path / "started", make_store)
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "PYTHONPATH": str(Path(__file__).parent)}
    done = subprocess.run(
        [*launch, *arguments(*TWO)], cwd=folder, env=environment, capture_output=True, text=True, timeout=240
    )
    assert done.returncode == 0, done.stderr
    assert "Traceback" not in done.stderr and "sync_dist" not in done.stderr
    final = torch.load(last_good(folder / "run"), weights_only=True)["state_dict"]
    for key, value in seen(two, 2)[0]["state"].items():
        assert torch.equal(final[key], value), key
