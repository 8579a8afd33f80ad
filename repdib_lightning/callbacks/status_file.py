"""``status.json`` in a run's folder: what became of the run. Nothing here imports torch or Lightning."""

from __future__ import annotations

import json
import os
import socket
import time
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Literal

from repdib_lightning.callbacks.checkpoint_files import is_alive
from repdib_lightning.data.files import whole_file
from repdib_lightning.errors import UserError

NAME = "status.json"
State = Literal["running", "finished", "preempted", "interrupted", "failed", "killed"]
_STATES = ("running", "finished", "preempted", "interrupted", "failed", "killed")
_SILENT_FOR = 600.0


@dataclass
class Status:
    """What became of a run.

    Attributes:
        state: ``running``; ``finished``; ``preempted`` by SIGTERM; ``interrupted`` at the keyboard; ``failed`` with an
            ``error``; ``killed``: it says that it is running, but its process is gone (never written, only read).
        process: number of the process.
        process_started: when that process began, in clock ticks since the machine started; tells a process from a
            later one with its number. 0 where the system does not say.
        host: name of its machine.
        job: the SLURM job, or empty.
        started: when training was first started or last resumed, in seconds since 1970.
        updated: when this was written.
        step: optimiser steps made.
        epoch: epochs completed.
        error: one line, where it failed.
    """

    state: State
    process: int
    process_started: int
    host: str
    job: str
    started: float
    updated: float
    step: int = 0
    epoch: int = 0
    error: str = ""

    @classmethod
    def of_this_process(cls) -> Status:
        """A run that this process begins now."""
        now, process = time.time(), os.getpid()
        return cls("running", process, _started(process), socket.gethostname(), _job(), now, now)

    def write(self, run: Path) -> None:
        """Write ``<run>/status.json``, whole. Raises UserError if it cannot be written."""
        self.updated = time.time()
        with whole_file(run / NAME) as path:
            path.write_text(json.dumps(asdict(self), indent=1) + "\n")


def read_status(run: Path) -> Status | None:
    """Return the status of a run, or None where it has none.

    A run that claims to be running is reported as ``killed`` when its process is gone. On another machine that cannot
    be seen: there, it is when the same SLURM job is running anew, or when nothing was written for ten minutes.

    Raises:
        UserError: the file is not what this package writes.
    """
    path = run / NAME
    try:
        status = Status(**json.loads(path.read_text()))
        if status.state not in _STATES:
            raise ValueError(status.state)
    except FileNotFoundError:
        return None
    except (OSError, TypeError, ValueError) as error:
        raise UserError(f"{path}: not a run's status ({error}); remove it to go on") from error
    if status.state == "running" and not _lives(status):
        status.state = "killed"
    return status


def _lives(status: Status) -> bool:
    if status.host != socket.gethostname():
        requeued = status.job != "" and status.job == _job()
        return not requeued and time.time() - status.updated < _SILENT_FOR
    return is_alive(status.process) and _started(status.process) == status.process_started


def _started(process: int) -> int:
    try:
        fields = Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()
    except OSError:
        return 0
    return int(fields[19])


def _job() -> str:
    return os.environ.get("SLURM_JOB_ID", "")
