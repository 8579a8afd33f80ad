"""Applies a function to many things in several processes, and gives the results in order."""

from __future__ import annotations

import multiprocessing
import os
import signal
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from multiprocessing.connection import wait
from threading import Thread
from types import TracebackType
from typing import Any, TypeVar

from repdib_lightning.errors import UserError

Item = TypeVar("Item")
Result = TypeVar("Result")
_AHEAD = 3


class Workers:
    """Processes that are started when they are first needed; with one job, all is done in this process.

    Use as a context manager: leaving it ends the processes, which also end when this one is killed.

    Raises:
        UserError: fewer than one job.
    """

    def __init__(self, jobs: int) -> None:
        if jobs < 1:
            raise UserError(f"--jobs must be at least 1, is {jobs}")
        self.jobs = jobs
        self._pool: ProcessPoolExecutor | None = None

    def __enter__(self) -> Workers:
        if self.jobs > 1:
            context = multiprocessing.get_context("spawn")
            self._pool = ProcessPoolExecutor(self.jobs, mp_context=context, initializer=_begin)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._pool is not None:
            self._pool.shutdown(cancel_futures=True)

    def map(self, function: Callable[[Item], Result], items: Iterable[Item]) -> Iterator[Result]:
        """Results in the order of the items; a few a process are under way or waiting, so memory stays bounded.

        Raises:
            UserError: a process died, or what the function raised.
        """
        if self._pool is None:
            yield from map(function, items)
            return
        waiting: deque[Future[Any]] = deque()
        try:
            for item in items:
                waiting.append(self._pool.submit(function, item))
                if len(waiting) >= _AHEAD * self.jobs:
                    yield waiting.popleft().result()
            while waiting:
                yield waiting.popleft().result()
        except BrokenProcessPool as error:
            told = "a process that reads died (out of memory, or a script without a main guard); try --jobs 1"
            raise UserError(told) from error


def _begin() -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent ends its workers
    Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    assert parent is not None
    wait([parent.sentinel])
    os._exit(1)
