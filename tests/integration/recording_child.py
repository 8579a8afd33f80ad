"""A small recording that a process of its own writes, and may be killed at."""

from __future__ import annotations

import multiprocessing
import os
import signal
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from repdib_lightning.data.schema import FactorSpec
from repdib_lightning.data.writer import EpisodeWriter
from repdib_lightning.records import ActionSpec, ArraySpec

LENGTHS = (5, 1, 7)
_STEPS = ("pwrite", "fdatasync", "fsync", "replace")


def writer(path: Path, *, seed: int = 0, repeats: int = 1, resume: bool = True, **changed: Any) -> EpisodeWriter:
    """The writer of the recording, whose episodes are those of LENGTHS, ``repeats`` times over."""
    stated: dict[str, Any] = {
        "rows": sum(LENGTHS) * repeats,
        "episodes": len(LENGTHS) * repeats,
        "observations": {"eye": ArraySpec((3, 9, 9)), "joints": ArraySpec((2,), "float32")},
        "actions": ActionSpec("discrete", 3),
        "factors": {"cell": FactorSpec("endogenous", "categorical", 4), "light": FactorSpec("exogenous", "continuous")},
        "masks": {"eye": (9, 9)},
        "rewards": True,
        "attributes": {"configuration": {"samples": 13 * repeats, "seed": seed, "clips": None}, "seed": seed},
    }
    return EpisodeWriter(path, **stated | changed, resume=resume)


def episode(number: int, *, seed: int = 0) -> dict[str, Any]:
    """Arguments of ``add_episode``."""
    random = np.random.default_rng([seed, number])
    length = LENGTHS[number % len(LENGTHS)]
    return {
        "observations": {
            "eye": random.integers(0, 256, (length, 3, 9, 9), dtype=np.uint8),
            "joints": random.normal(size=(length, 2)).astype(np.float32),
        },
        "actions": random.integers(0, 3, length - 1),
        "rewards": random.normal(size=length - 1).astype(np.float32),
        "terminations": random.random(length - 1) < 0.5,
        "truncations": random.random(length - 1) < 0.5,
        "factors": {"cell": random.integers(0, 4, length), "light": random.random(length)},
        "masks": {"eye": random.random((length, 9, 9)) < 0.5},
        "evaluation": number % 3 == 2,
    }


def record(path: Path, *, repeats: int = 1, begun: Any = None, **options: Any) -> int:
    """Record, or go on; return how many episodes were there. ``begun`` is an event, set once the file is open."""
    with writer(path, repeats=repeats, **options) as open_writer:
        found = open_writer.episodes_done
        if begun is not None:
            begun.set()
        for number in range(found, len(LENGTHS) * repeats):
            open_writer.add_episode(**episode(number))
    return found


def _die_at(step: int) -> None:
    """Kill this process at the given call of those that change the disk; half of what it should write is written."""
    calls = iter(range(step + 1))

    def dying(name: str) -> Callable[..., Any]:
        real = getattr(os, name)

        def call(*arguments: Any) -> Any:
            if next(calls) == step:
                if name == "pwrite":
                    handle, content, offset = arguments
                    real(handle, content[: len(content) // 2], offset)
                os.kill(os.getpid(), signal.SIGKILL)
            return real(*arguments)

        return call

    for name in _STEPS:
        setattr(os, name, dying(name))


def _child(path: str, repeats: int, step: int | None, begun: Any) -> None:
    if step is not None:
        _die_at(step)
    record(Path(path), repeats=repeats, begun=begun)


def in_child(path: Path, *, repeats: int = 1, die_at: int | None = None, kill_after: float | None = None) -> int | None:
    """Record in another process.

    Args:
        path: the store.
        repeats: of the episodes.
        die_at: number of the call that changes the disk at which it dies.
        kill_after: seconds after it has opened the file, at which it is killed.

    Returns:
        Its exit code; negative: killed.
    """
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(["repdib_lightning.data.writer"])
    begun = None if kill_after is None else context.Event()
    process = context.Process(target=_child, args=(str(path), repeats, die_at, begun))
    process.start()
    if begun is not None:
        begun.wait(60)
        time.sleep(kill_after or 0)
        process.kill()
    process.join()
    return process.exitcode
