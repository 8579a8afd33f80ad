"""``finetune dt`` that is killed goes on to the same bits, from the command line."""

from __future__ import annotations

import os
import signal
import sys
import time
from pathlib import Path

import torch
from safetensors.torch import load_file

sys.path.insert(0, str(Path(__file__).parent))
sys.path.insert(0, str(Path(__file__).parents[1] / "unit/rl"))
from killing import command, start
from small_choices import choices_bundle, record_choices

SMALL = ["--layers", "1", "--heads", "1", "--width", "8", "--context", "3", "--batch_size", "4", "--epochs", "40",
         "--steps_per_epoch", "4", "--env", "none"]  # fmt: skip


def test_a_kill_between_two_checkpoints_changes_nothing(tmp_path):
    record_choices(tmp_path / "d.h5", 30)
    choices_bundle(tmp_path / "b", quantised=True)
    words = ["finetune", "dt", "--data", "d.h5", "--encoder", "b", *SMALL]
    assert command(tmp_path, *words, "--run", "whole") == 0
    process = start(tmp_path, [*words, "--run", "killed"], {})
    until = time.monotonic() + 60
    while len(list((tmp_path / "killed/checkpoints").glob("step-*.ckpt"))) < 3 and time.monotonic() < until:
        time.sleep(0.005)
    os.kill(process.pid, signal.SIGKILL)
    process.join()
    assert process.exitcode == -signal.SIGKILL and not (tmp_path / "killed/outcome.json").exists()
    assert command(tmp_path, *words, "--run", "killed") == 2
    assert "go on with it by --resume" in (tmp_path / "output.txt").read_text()
    assert command(tmp_path, *words, "--run", "killed", "--resume", "true") == 0
    assert (tmp_path / "killed/progress.csv").read_text() == (tmp_path / "whole/progress.csv").read_text()
    ours, theirs = (load_file(tmp_path / run / "policy.safetensors") for run in ("killed", "whole"))
    assert ours.keys() == theirs.keys() and all(torch.equal(ours[name], theirs[name]) for name in ours)
