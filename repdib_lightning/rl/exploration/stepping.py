"""Several environments stepped together, in this process or in worker processes, each of which has several of them.

gymnasium's have a process an environment, which with steps of under a millisecond wait for each other most of the time.
"""

from __future__ import annotations

import multiprocessing
import os
import pickle
import signal
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from multiprocessing.connection import Connection
from typing import Any

import gymnasium
import numpy as np

from repdib_lightning.errors import UserError

Opener = Callable[[], gymnasium.Env[Any, Any]]
_PATIENCE = 5.0
"""Seconds that a worker has to end by itself."""


@dataclass(frozen=True)
class Moved:
    """What an environment shows after a step, or at the beginning of an episode.

    Attributes:
        shown: name -> observation, or a single one without a name. factors: name -> ground truth.
        reward, terminated, truncated: of the step.
    """

    shown: Any
    factors: dict[str, np.ndarray]
    reward: float = 0.0
    terminated: bool = False
    truncated: bool = False


class Together:
    """Environments in this process, one after the other.

    Args:
        openers: what opens each of them.
    """

    def __init__(self, openers: Sequence[Opener]) -> None:
        self._environments = [opener() for opener in openers]
        self._actions = np.zeros((0, 0))

    def reset(self, seeds: Sequence[int]) -> list[Moved]:
        """Begin an episode in each."""
        begun = [env.reset(seed=seed) for env, seed in zip(self._environments, seeds, strict=True)]
        return [Moved(_kept(shown), info.get("factors", {})) for shown, info in begun]

    def send(self, actions: np.ndarray) -> None:
        """Give each its action, (E, A), for the next :meth:`receive`."""
        self._actions = actions

    def receive(self) -> list[Moved]:
        """Take the step that was sent."""
        moved = []
        for environment, action in zip(self._environments, self._actions, strict=True):
            shown, reward, terminated, truncated, info = environment.step(action)
            moved.append(Moved(_kept(shown), info.get("factors", {}), float(reward), terminated, truncated))
        return moved

    def close(self) -> None:
        """Close them."""
        for environment in self._environments:
            environment.close()


class Apart:
    """The same in worker processes, which take their step while this process does something else.

    Workers are deaf to Ctrl-C and to requests to end, which may reach them as they reach this process; they end with
    the connection to it, however that ends.

    Args:
        openers: what opens each environment; they pickle. workers: processes; each has as many environments as the
            others, or one more.

    Raises:
        UserError: what an environment raises as such; or a worker that was killed.
    """

    def __init__(self, openers: Sequence[Opener], workers: int) -> None:
        context = multiprocessing.get_context("spawn")
        shares = np.array_split(np.arange(len(openers)), min(workers, len(openers)))
        self._shares = [slice(share[0], share[-1] + 1) for share in shares]
        self._connections: list[Connection] = []
        self.processes: list[Any] = []
        try:
            for share in self._shares:
                mine, theirs = context.Pipe()
                process = context.Process(target=_serve, args=(theirs, list(openers[share])), daemon=True)
                process.start()
                theirs.close()
                self._connections.append(mine)
                self.processes.append(process)
            for connection in self._connections:
                _answer(connection)
        except BaseException:
            self.close()
            raise

    def reset(self, seeds: Sequence[int]) -> list[Moved]:
        """Begin an episode in each."""
        self._tell("reset", seeds)
        return self.receive()

    def send(self, actions: np.ndarray) -> None:
        """Give each its action, (E, A), for the next :meth:`receive`."""
        self._tell("step", actions)

    def receive(self) -> list[Moved]:
        """Wait for what was sent."""
        return [moved for connection in self._connections for moved in _answer(connection)]

    def _tell(self, what: str, each: Any) -> None:
        try:
            for connection, share in zip(self._connections, self._shares, strict=True):
                connection.send((what, each[share]))
        except OSError as error:
            raise _died() from error

    def close(self) -> None:
        """End the workers, also those that do not answer."""
        for connection in self._connections:
            connection.close()
        for process in self.processes:
            process.join(_PATIENCE)
            if process.is_alive():
                process.kill()
                process.join()


def stepper(openers: Sequence[Opener], processes: bool) -> Together | Apart:
    """As many workers as there are cores, and no more than environments; or none."""
    return Apart(openers, len(os.sched_getaffinity(0))) if processes else Together(openers)


def _answer(connection: Connection) -> Any:
    try:
        answer = connection.recv()
    except (EOFError, OSError) as error:
        raise _died() from error
    if isinstance(answer, BaseException):
        raise answer
    return answer


def _died() -> UserError:
    return UserError("a worker process that steps environments has ended; was it killed, or out of memory?")


def _serve(connection: Connection, openers: Sequence[Opener]) -> None:
    """A worker: opens its environments, then answers until the connection ends."""
    for asked in (signal.SIGINT, signal.SIGTERM):
        signal.signal(asked, signal.SIG_IGN)
    together: Together | None = None
    try:
        together = Together(openers)
        connection.send([])
        while True:
            what, given = connection.recv()
            if what == "reset":
                connection.send(together.reset(given))
            else:
                together.send(given)
                connection.send(together.receive())
    except (EOFError, ConnectionError):
        pass
    except Exception as error:  # whatever an environment raises
        connection.send(_sendable(error))
    finally:
        if together is not None:
            together.close()


def _sendable(error: Exception) -> Exception:
    """The error, or its text where it cannot go through a pipe."""
    try:
        pickle.loads(pickle.dumps(error))
    except Exception:  # its constructor wants something else than its arguments
        return RuntimeError(f"{type(error).__name__}: {error}")
    return error


def _kept(shown: Any) -> Any:
    """A copy: some environments draw into the same array again."""
    return {name: np.array(part) for name, part in shown.items()} if isinstance(shown, dict) else np.array(shown)
