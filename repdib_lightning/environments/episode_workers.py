"""Episodes that worker processes record, in order, whatever the number of workers."""

from __future__ import annotations

import multiprocessing
import signal
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from multiprocessing.connection import Connection, wait
from typing import Any, Protocol

from repdib_lightning.errors import UserError

EVALUATION_SHARE = 0.3


class Recording(Protocol):
    """What a recording is made of; pickles."""

    def open(self) -> Callable[[int], dict[str, Any]]:
        """Open the simulator in this process: number of an episode -> arguments of ``EpisodeWriter.add_episode``."""
        ...


def evaluation_episodes(episodes: int, share: float = EVALUATION_SHARE) -> set[int]:
    """Which of the episodes of a recording are never trained on: a share of them, spread evenly.

    Of few episodes up to half, so that there are 4 where possible: probes are fitted on half of them and scored on the
    other half.
    """
    count = max(min(4, episodes // 2), round(share * episodes)) if episodes > 1 else 0
    return {int((i + 0.5) * episodes / count) for i in range(count)}


def recorded_in_order(recording: Recording, episodes: Sequence[int], workers: int) -> Iterator[dict[str, Any]]:
    """What the recording gives for these episodes, in their order.

    At most two episodes a worker are under way or waiting, so memory stays bounded.

    Raises:
        UserError: fewer than one worker, or what a worker raised.
    """
    if workers < 1:
        raise UserError(f"workers={workers}: must be at least 1")
    workers = min(workers, len(episodes))
    with _worker_connections(recording, workers) as connections:
        waiting: dict[int, dict[str, Any]] = {}
        idle: list[Any] = list(connections)
        given = 0
        for place, wanted in enumerate(episodes):
            while wanted not in waiting:
                while idle and given < min(len(episodes), place + 2 * workers):
                    _send(idle.pop(), episodes[given])
                    given += 1
                for connection in wait([c for c in connections if c not in idle]):
                    episode, result = _receive(connection)
                    waiting[episode] = result
                    idle.append(connection)
            yield waiting.pop(wanted)


def _send(connection: Any, episode: int) -> None:
    try:
        connection.send(episode)
    except OSError as error:
        raise _died() from error


def _died() -> UserError:
    return UserError("a rendering process died (out of memory, or a fault of the graphics driver); try --workers 1")


def _serve(connection: Connection, recording: Recording) -> None:
    """A worker: receives episode numbers, sends back (number, episode) or (number, exception)."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent stops its workers
    try:
        from repdib_lightning.environments.rendering import prepare_rendering

        prepare_rendering(threads=0)
        record = recording.open()
        while (episode := connection.recv()) is not None:
            connection.send((episode, record(episode)))
    except (EOFError, BrokenPipeError):
        return  # the parent is gone
    except Exception as error:
        connection.send((-1, UserError(str(error)) if isinstance(error, UserError) else RuntimeError(repr(error))))


def _receive(connection: Any) -> tuple[int, dict[str, Any]]:
    try:
        episode, result = connection.recv()
    except EOFError as error:
        raise _died() from error
    if isinstance(result, Exception):
        raise result
    return episode, result


@contextmanager
def _worker_connections(recording: Recording, workers: int) -> Iterator[list[Any]]:
    context = multiprocessing.get_context("spawn")
    connections: list[Any] = []
    processes = []
    try:
        with _main_not_imported_again():
            for _ in range(workers):
                ours, theirs = context.Pipe()
                process = context.Process(target=_serve, args=(theirs, recording), daemon=True)
                process.start()
                theirs.close()
                connections.append(ours)
                processes.append(process)
        yield connections
    finally:
        for process in processes:
            process.terminate()
        for process in processes:
            process.join()
        for connection in connections:
            connection.close()


@contextmanager
def _main_not_imported_again() -> Iterator[None]:
    """Hide the main script from spawned processes: they need only this package, and scripts may lack a main guard."""
    main = sys.modules["__main__"]
    hidden: dict[str, Any] = {name: vars(main).pop(name) for name in ("__file__", "__spec__") if name in vars(main)}
    main.__spec__ = None
    try:
        yield
    finally:
        vars(main).update(hidden)
