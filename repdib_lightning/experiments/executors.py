"""Where points run: on this machine, a few at a time, or in a SLURM queue. One interface for both."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import Any, Protocol

from repdib_lightning.errors import UserError, nearest
from repdib_lightning.experiments.attempt import Attempt, stop_all
from repdib_lightning.experiments.points import Point

EXECUTORS = ("local", "slurm")


class Executor(Protocol):
    """Takes points, and runs each once.

    Attributes:
        returns_at_once: whether points go on after this process has ended.
    """

    returns_at_once: bool

    def submit(self, points: Sequence[Point]) -> None:
        """Hand over points."""
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

    def submit(self, points: Sequence[Point]) -> None:
        """Queue the points; as many start as there is room for."""
        for point in points:
            attempt = Attempt(point)
            self._attempts.append(attempt)
            self._futures.append(self._pool.submit(attempt.run))

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
        stop_all(self._attempts)
        self._pool.shutdown(wait=True)


def build_executor(name: str, folder: Path, jobs: int | None, threads: int, slurm: Mapping[str, Any]) -> Executor:
    """The executor of a name.

    Args:
        name: one of ``EXECUTORS``. folder: of the suite's runs.
        jobs: points at a time; None for as many as there are cores for here, or as the SLURM parameters say.
        threads: of each point. slurm: parameters of its job.

    Raises:
        UserError: an unknown name, fewer jobs than 1, or what
            :class:`~repdib_lightning.experiments.slurm.SlurmExecutor` complains of.
    """
    if name not in EXECUTORS:
        raise UserError(f"--executor: unknown '{name}', {nearest(name, EXECUTORS)}")
    if jobs is not None and jobs < 1:
        raise UserError(f"--jobs must be at least 1, is {jobs}")
    if name == "local":
        return LocalExecutor(jobs or max(1, (os.cpu_count() or 1) // threads))
    from repdib_lightning.experiments.slurm import SlurmExecutor

    return SlurmExecutor(folder / "slurm", jobs, threads, slurm)
