"""The status file, and what is made of a process that is gone."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest

from repdib_lightning.callbacks import Status, exit_codes, read_status
from repdib_lightning.errors import UserError


def written(run: Path, **changes: Any) -> Status | None:
    """What is read after a status with these changes was written."""
    status = Status.of_this_process()
    status.write(run)
    facts = json.loads((run / "status.json").read_text())
    (run / "status.json").write_text(json.dumps({**facts, **changes}))
    return read_status(run)


def test_a_run_without_a_status(tmp_path: Path) -> None:
    assert read_status(tmp_path) is None


def test_this_process_runs(tmp_path: Path) -> None:
    status = written(tmp_path, step=7)
    assert status is not None
    assert (status.state, status.process, status.step) == ("running", os.getpid(), 7)
    assert abs(status.updated - time.time()) < 60


def test_a_dead_process_was_killed(tmp_path: Path) -> None:
    gone = subprocess.Popen(["true"])
    gone.wait()
    status = written(tmp_path, process=gone.pid)
    assert status is not None
    assert status.state == "killed"


def test_another_process_with_the_same_number_is_not_the_run(tmp_path: Path) -> None:
    status = written(tmp_path, process=1)
    assert status is not None
    assert status.state == "killed"


@pytest.mark.parametrize("state", ["finished", "preempted", "interrupted", "failed"])
def test_what_ended_stays_ended(tmp_path: Path, state: str) -> None:
    status = written(tmp_path, state=state, process=1, error="why")
    assert status is not None
    assert (status.state, status.error) == (state, "why")


@pytest.mark.parametrize(
    ("job", "age", "state"), [("", 5, "running"), ("", 5000, "killed"), ("12", 5, "killed"), ("13", 5, "running")]
)
def test_on_another_machine(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, job: str, age: float, state: str) -> None:
    monkeypatch.setenv("SLURM_JOB_ID", "12")
    status = written(tmp_path, host="elsewhere", process=1, job=job, updated=time.time() - age)
    assert status is not None
    assert status.state == state


@pytest.mark.parametrize("text", ["", "{", "[]", "{}", '{"state": "running"}'])
def test_a_file_that_is_no_status(tmp_path: Path, text: str) -> None:
    (tmp_path / "status.json").write_text(text)
    with pytest.raises(UserError, match=r"status\.json: not a run's status"):
        read_status(tmp_path)


def test_a_state_that_does_not_exist(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="sleeping"):
        written(tmp_path, state="sleeping")


def test_other_exits_keep_their_code() -> None:
    with pytest.raises(SystemExit) as ending, exit_codes():
        raise SystemExit(5)
    assert ending.value.code == 5


def test_reading_a_status_or_finding_a_checkpoint_needs_neither_torch_nor_lightning() -> None:
    code = "import sys, repdib_lightning.callbacks as c; c.read_status, c.last_good; print('torch' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout == "False\n"
