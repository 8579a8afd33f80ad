"""Shoulder exercises seen by a smartwatch: the data set that comes with seglearn.

Burns, Leung, Hardisty, Whyne, Henry, McLachlin, Shoulder physiotherapy exercise recognition: machine learning the
inertial signals from a smartwatch, arXiv 1802.01489.
"""

from __future__ import annotations

import hashlib
import io
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

from repdib_lightning.data.schema import FactorSpec
from repdib_lightning.data.writer import EpisodeWriter
from repdib_lightning.errors import UserError
from repdib_lightning.records import ArraySpec

SHA256 = "eb122f23cdf06ef6bd6c6c5312958ec5cf9d038e2e6d457b8081662c75a42537"
"""Of the published file, ``seglearn/data/watch_dataset.npy``."""

RATE = 50
SIDES = ("left", "right")
HELD_OUT = 2
"""Readings a second; names of side 0 and 1; how many subjects, the last ones, are marked for evaluation."""

_SENSORS = {"acceleration": slice(0, 3), "gyroscope": slice(3, 6)}
_KEYS = ("X", "y", "subject", "side", "y_labels")


@dataclass(frozen=True)
class _Recording:
    """One exercise of one person: (n, 6) float32 readings, and the class of each factor."""

    readings: np.ndarray
    levels: dict[str, int]


def import_smartwatch(
    source: Path,
    output: Path,
    *,
    window: float = 4.0,
    hop: float = 2.0,
    trust: bool = False,
    overwrite: bool = False,
    progress: bool = True,
) -> Path:
    """Cut the 140 recordings of ``watch_dataset.npy`` into windows; each is an episode of one row.

    Observations ``acceleration`` and ``gyroscope``, (T, 3) float32 each at 50 Hz, in the units of the file (by their
    size g, gravity included, and rad/s). Factors, all categorical: activity (7, endogenous), subject (10) and side (2),
    both exogenous. Windows of one recording share its number. Those of the last two subjects are marked for evaluation.

    Args:
        source: the file; it holds a pickle, which can run any program, so that only the published one is opened.
        output: the store to write (.h5).
        window: length of a window in seconds; what is left at the end of a recording is dropped.
        hop: seconds from the beginning of a window to that of the next.
        trust: open a file of other content, too.
        overwrite: replace an existing output.
        progress: show a progress bar on a terminal.

    Returns:
        The output.

    Raises:
        UserError: naming file and key: not the published file, or with ``trust`` not one of its layout; a window or
            hop that is no whole number of readings; no recording as long as a window. No output is left.
    """
    source, output = Path(source), Path(output)
    length, step = _steps("window", window, 2), _steps("hop", hop, 1)
    content = _read(source, trust)
    stored = _unpickle(source, content)
    try:
        classes, recordings = _recordings(source, stored)
    except (TypeError, ValueError) as error:
        raise error if isinstance(error, UserError) else UserError(f"{source}: not recordings ({error})") from error
    cuts = [range(0, len(recording.readings) - length + 1, step) for recording in recordings]
    windows = sum(map(len, cuts))
    if not windows:
        raise UserError(f"{source}: no recording is as long as window={window} s")
    writer = EpisodeWriter(
        output,
        rows=windows,
        episodes=windows,
        observations={name: ArraySpec((length, 3), "float32") for name in _SENSORS},
        actions=None,
        factors=_factors(classes),
        attributes=_attributes(content, classes, window, hop),
        overwrite=overwrite,
        recordings=True,
    )
    with writer, tqdm(total=windows, desc="import", unit="window", disable=None if progress else True) as bar:
        for number, (recording, starts) in enumerate(zip(recordings, cuts, strict=True)):
            for start in starts:
                _add(writer, recording, slice(start, start + length), number, classes)
                bar.update()
    short = sum(not starts for starts in cuts)
    if short:
        print(f"{source}: shorter than a window, not imported: {short} of {len(cuts)} recordings", file=sys.stderr)
    return output


def _steps(name: str, seconds: float, least: int) -> int:
    """Seconds as a number of readings."""
    steps = seconds * RATE
    if not least <= steps < 1e9 or abs(steps - round(steps)) > 1e-6:
        raise UserError(f"{name}={seconds}: must be a multiple of {1 / RATE} s, at least {least / RATE} s")
    return round(steps)


def _read(source: Path, trust: bool) -> bytes:
    """The whole file; what is hashed is what will be unpickled."""
    try:
        content = source.read_bytes()
    except OSError as error:
        raise UserError(
            f"{source}: cannot be read ({error.strerror}); expected seglearn's watch_dataset.npy"
        ) from error
    if hashlib.sha256(content).hexdigest() != SHA256 and not trust:
        raise UserError(
            f"{source}: not the published watch_dataset.npy (its sha256 differs), and a pickle can run any program; "
            "pass --trust if you know where it comes from"
        )
    return content


def _unpickle(source: Path, content: bytes) -> dict[str, Any]:
    try:
        stored = np.load(io.BytesIO(content), allow_pickle=True).item()
    except Exception as error:  # a pickle may raise anything
        raise UserError(
            f"{source}: no pickled dictionary in a .npy file ({str(error).partition(chr(10))[0]})"
        ) from error
    missing = [key for key in _KEYS if key not in stored] if isinstance(stored, dict) else list(_KEYS)
    if missing:
        raise UserError(f"{source}: key '{missing[0]}' is missing; expected a dictionary of {', '.join(_KEYS)}")
    return stored


def _recordings(source: Path, stored: dict[str, Any]) -> tuple[dict[str, list[str]], list[_Recording]]:
    """Names of the classes of each factor, and all recordings."""
    people = sorted({int(number) for number in stored["subject"]})
    classes = {
        "activity": [str(name) for name in stored["y_labels"]],
        "subject": [str(number) for number in people],
        "side": list(SIDES),
    }
    columns = [stored[key] for key in ("X", "y", "subject", "side")]
    if len({len(column) for column in columns}) != 1:
        raise UserError(f"{source}: 'X', 'y', 'subject' and 'side' have {[len(column) for column in columns]} entries")
    recordings = []
    for number, (given, activity, subject, side) in enumerate(zip(*columns, strict=True)):
        readings = np.asarray(given, np.float32)
        if readings.ndim != 2 or readings.shape[1] != 6:
            raise UserError(f"{source}: X[{number}] has shape {readings.shape}; expected (n, 6)")
        levels = {"activity": int(activity), "subject": people.index(int(subject)), "side": int(side)}
        wrong = [name for name, level in levels.items() if not 0 <= level < len(classes[name])]
        if wrong:
            raise UserError(f"{source}: recording {number} has {wrong[0]} {levels[wrong[0]]}, which has no name")
        recordings.append(_Recording(readings, levels))
    return classes, recordings


def _factors(classes: dict[str, list[str]]) -> dict[str, FactorSpec]:
    return {
        name: FactorSpec("endogenous" if name == "activity" else "exogenous", "categorical", len(names))
        for name, names in classes.items()
    }


def _attributes(content: bytes, classes: dict[str, list[str]], window: float, hop: float) -> dict[str, Any]:
    return {
        "environment": "smartwatch",
        "licence": "BSD-3-Clause, copyright 2018 David M. Burns (seglearn)",
        "source": f"seglearn's watch_dataset.npy, of arXiv 1802.01489; sha256 {hashlib.sha256(content).hexdigest()}",
        "configuration": {"window": window, "hop": hop},
        "classes": classes,
        "channels": {"acceleration": ["ax", "ay", "az"], "gyroscope": ["wx", "wy", "wz"]},
        "rate": dict.fromkeys(_SENSORS, RATE),
    }


def _add(
    writer: EpisodeWriter, recording: _Recording, steps: slice, number: int, classes: dict[str, list[str]]
) -> None:
    people = len(classes["subject"])
    writer.add_episode(
        observations={name: recording.readings[None, steps, channels] for name, channels in _SENSORS.items()},
        factors={name: np.array([level]) for name, level in recording.levels.items()},
        evaluation=people > HELD_OUT and recording.levels["subject"] >= people - HELD_OUT,
        recording=number,
    )
