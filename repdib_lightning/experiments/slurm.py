"""Runs points as SLURM jobs, through submitit, and asks which of them are still in the queue."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

from repdib_lightning.errors import UserError, nearest
from repdib_lightning.experiments.attempt import Attempt, stop_all
from repdib_lightning.experiments.points import Point


class SlurmExecutor:
    """One SLURM array job for all points, through submitit.

    A job that reaches its time limit saves a checkpoint, is put back into the queue and goes on where it stopped.

    Args:
        folder: for submitit's scripts and logs.
        jobs: how many may run at a time; None for what the parameters say.
        threads: cores of each.
        parameters: of the jobs, by submitit's names (``timeout_min``, ``mem_gb``, ``gpus_per_node``,
            ``slurm_partition``, ``slurm_array_parallelism``, ...).

    Raises:
        UserError: submitit is not installed, there is no SLURM here, or it does not know a parameter.
    """

    returns_at_once = True

    def __init__(self, folder: Path, jobs: int | None, threads: int, parameters: Mapping[str, Any]) -> None:
        try:
            import submitit
        except ImportError as error:
            raise UserError("--executor slurm needs submitit: pip install 'repdib_lightning[slurm]'") from error
        for command in ("sbatch", "srun"):
            if shutil.which(command) is None:
                raise UserError(f"--executor slurm: no command '{command}' here; submit from a machine of the cluster")
        common = submitit.AutoExecutor._valid_parameters()
        known = common | {f"slurm_{name}" for name in common | submitit.SlurmExecutor._valid_parameters()}
        for name in parameters:
            if name not in known:
                raise UserError(f"suite's slurm parameters: unknown '{name}', {nearest(name, known)}")
        chosen: dict[str, Any] = {"name": "repdib", "timeout_min": 240, "cpus_per_task": threads, **parameters}
        if jobs is not None:
            chosen["slurm_array_parallelism"] = jobs
        self._queue = submitit.AutoExecutor(folder=folder, cluster="slurm")
        try:
            self._queue.update_parameters(**chosen)
        except (AssertionError, TypeError, ValueError) as error:
            raise UserError(f"suite's slurm parameters: {error}") from error

    def submit(self, points: Sequence[Point]) -> None:
        """Put all points into the queue, and note each one's job in its record. Raises UserError if SLURM refuses."""
        if not points:
            return
        for point in points:
            _note_job(point, "")
        try:
            with self._queue.batch():
                jobs = [self._queue.submit(_QueuedPoint(point)) for point in points]
        except (OSError, RuntimeError) as error:
            reason = str(error).strip().splitlines() or ["it said nothing"]
            raise UserError(f"sbatch did not take the jobs: {reason[-1]}") from error
        for point, job in zip(points, jobs, strict=True):
            _note_job(point, job.job_id)

    def busy(self) -> bool:
        """They go on without this process."""
        return False

    def stop(self) -> None:
        """They go on without this process; ``scancel`` ends them."""


class _QueuedPoint:
    """A point as a submitit task. At the time limit, ``checkpoint`` stops it before it goes back into the queue."""

    _attempt: Attempt | None = None

    def __init__(self, point: Point) -> None:
        self.point = point

    def __call__(self) -> bool:
        from submitit import JobEnvironment

        self._attempt = Attempt(self.point, JobEnvironment().job_id)
        # In a thread, because signals interrupt the main one. SLURM sends submitit's signal to the commands too, which
        # would die of it; the thread blocks it, and they inherit that.
        warning = getattr(signal, f"SIG{JobEnvironment.USR_SIG}")
        with ThreadPoolExecutor(
            1, initializer=signal.pthread_sigmask, initargs=(signal.SIG_BLOCK, [warning])
        ) as thread:
            return thread.submit(self._attempt.run).result()

    def checkpoint(self) -> Any:
        from submitit.helpers import DelayedSubmission

        if self._attempt is not None:
            stop_all([self._attempt])
        return DelayedSubmission(_QueuedPoint(self.point))


def _note_job(point: Point, job: str) -> None:
    """Unless it runs already and writes its record itself, or has ended since."""
    with point.lock() as handle:
        if handle is None:
            return
        record = point.record()
        if record.finished or (job and record.error):
            return
        record.job, record.error = job, ""
        point.write(record)


def jobs_in_queue() -> set[str]:
    """Of this user's jobs, those that SLURM has not ended: ``17`` or ``17_3``. None at all where there is no SLURM.

    Raises:
        UserError: SLURM is here but does not answer.
    """
    command = ["squeue", "--noheader", "--array", "--format=%i", f"--user={os.getuid()}"]
    try:
        asked = subprocess.run(command, capture_output=True, text=True)
    except FileNotFoundError:
        return set()
    if asked.returncode != 0:
        lines = asked.stderr.strip().splitlines() or ["it said nothing"]
        raise UserError(f"squeue ended with exit code {asked.returncode}: {lines[-1]}")
    return set(asked.stdout.split())
