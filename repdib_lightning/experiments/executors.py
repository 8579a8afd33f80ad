"""Where points run: on this machine, a few at a time, or in a SLURM queue. One interface for both."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import Any, Protocol

from repdib_lightning.errors import UserError, nearest
from repdib_lightning.experiments.attempt import Attempt, run_point
from repdib_lightning.experiments.points import Point

EXECUTORS = ("local", "slurm")


class Executor(Protocol):
    """Takes points, and runs each once.

    Attributes:
        returns_at_once: whether points go on after this process has ended.
    """

    returns_at_once: bool

    def submit(self, points: Sequence[Point], redo: str = "") -> None:
        """Hand over points; ``redo`` is the first phase to do anew, or empty."""
        ...

    def busy(self) -> bool:
        """Whether any of them is still to end (False where they go on without this process)."""
        ...

    def stop(self) -> None:
        """End what runs here, so that it can go on later; what waits here does not start."""
        ...


class LocalExecutor:
    """A few points at a time as child processes.

    Args:
        jobs: how many.
    """

    returns_at_once = False

    def __init__(self, jobs: int) -> None:
        self._pool = ThreadPoolExecutor(jobs)
        self._attempts: list[Attempt] = []
        self._futures: list[Future[bool]] = []

    def submit(self, points: Sequence[Point], redo: str = "") -> None:
        """Queue the points; as many start as there is room for."""
        attempts = [Attempt(point, redo) for point in points]
        self._attempts += attempts
        self._futures += [self._pool.submit(attempt.run) for attempt in attempts]

    def busy(self) -> bool:
        """Whether a point waits or runs. Raises what an attempt raised by a fault of our own."""
        for future in self._futures:
            if future.done() and not future.cancelled():
                future.result()
        return any(not future.done() for future in self._futures)

    def stop(self) -> None:
        """SIGTERM to what runs, as a preemption does; training saves a checkpoint then."""
        for future in self._futures:
            future.cancel()
        for attempt in self._attempts:
            attempt.stop()
        self._pool.shutdown(wait=True)


class SlurmExecutor:
    """One SLURM array job for all points, through submitit.

    A job that is preempted, or that reaches its time limit, is put back into the queue and goes on where it stopped.

    Args:
        folder: for submitit's scripts and logs.
        jobs: how many may run at a time.
        threads: cores of each.
        parameters: of the jobs, by submitit's names (``timeout_min``, ``mem_gb``, ``gpus_per_node``,
            ``slurm_partition``, ...).

    Raises:
        UserError: submitit is not installed, there is no SLURM here, or it does not know a parameter.
    """

    returns_at_once = True

    def __init__(self, folder: Path, jobs: int, threads: int, parameters: Mapping[str, Any]) -> None:
        try:
            import submitit
        except ImportError as error:
            raise UserError("--executor slurm needs submitit: pip install 'repdib_lightning[slurm]'") from error
        chosen: dict[str, Any] = {"name": "repdib", "timeout_min": 240, "cpus_per_task": threads, **parameters}
        try:
            self._queue = submitit.AutoExecutor(folder=folder, cluster="slurm")
            self._queue.update_parameters(slurm_array_parallelism=jobs, **chosen)
        except RuntimeError as error:
            raise UserError(f"--executor slurm: {error}") from error
        except (NameError, TypeError, ValueError) as error:
            raise UserError(f"suite's slurm parameters: {error}") from error

    def submit(self, points: Sequence[Point], redo: str = "") -> None:
        """Put all points into the queue, and note each one's job in its record."""
        tasks = [_QueuedPoint(point, redo) for point in points]
        with self._queue.batch():
            jobs = [self._queue.submit(task) for task in tasks]
        for point, job in zip(points, jobs, strict=True):
            _note_job(point, job.job_id)

    def busy(self) -> bool:
        """They go on without this process."""
        return False

    def stop(self) -> None:
        """They go on without this process; ``scancel`` ends them."""


class _QueuedPoint:
    """A point as a submitit task; ``checkpoint`` is what puts it back into the queue."""

    def __init__(self, point: Point, redo: str) -> None:
        self.point, self.redo = point, redo

    def __call__(self) -> bool:
        return run_point(self.point, self.redo)

    def checkpoint(self) -> Any:
        from submitit.helpers import DelayedSubmission

        return DelayedSubmission(_QueuedPoint(self.point, ""))


def _note_job(point: Point, job: str) -> None:
    """Unless it has begun already, and writes its record itself."""
    with point.lock() as handle:
        if handle is None:
            return
        record = point.record()
        if not record.finished:
            record.job, record.error = job, ""
            point.write(record)


def build_executor(name: str, folder: Path, jobs: int, threads: int, slurm: Mapping[str, Any]) -> Executor:
    """The executor of a name.

    Raises:
        UserError: an unknown name, fewer jobs than 1, or what :class:`SlurmExecutor` complains of.
    """
    if name not in EXECUTORS:
        raise UserError(f"--executor: unknown '{name}': {nearest(name, EXECUTORS)}")
    if jobs < 1:
        raise UserError(f"--jobs must be at least 1, is {jobs}")
    if name == "local":
        return LocalExecutor(jobs)
    return SlurmExecutor(folder / "slurm", jobs, threads, slurm)
