"""Reads one CSV file of a sensor and resamples it at even steps.

A line is ``YYYYMMDD_HH:MM:SS.ffffff,x,y,z``, without a header; about 100 lines a second (acceleration) or 50.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path

import numpy as np

from repdib_lightning.data.importers.mmact_notes import UnreadableFile

WIDTH = 3
_LONGEST = 600.0  # seconds; a stamp that is off by a day must not lengthen every clip of the store
_ROUND = 360
_HIGHEST = 3e38  # float32 holds a little more
_EXAMPLE = "20190301_10:11:12.123456"


@dataclass(frozen=True)
class Stream:
    """n readings: seconds (n,) float64 from the first, increasing; values (n, 3) float64."""

    seconds: np.ndarray
    values: np.ndarray

    def steps(self, rate: float) -> int:
        """Steps at ``rate`` Hz from the first reading on, none of them after the last."""
        return math.floor(float(self.seconds[-1]) * rate + 1e-6) + 1


def read_stream(file: Path) -> Stream:
    """Read all of a file; of readings with the same stamp, the first counts.

    Raises:
        UnreadableFile: empty, with a header, or with a line of another form (its number and what is wrong with it).
    """
    try:
        lines = file.read_text(encoding="utf-8").splitlines()
    except OSError as error:
        raise UnreadableFile(f"cannot be read ({error.strerror or error})") from error
    except UnicodeDecodeError as error:
        raise UnreadableFile("is no text file") from error
    while lines and not lines[-1].strip():
        lines.pop()
    if not lines:
        raise UnreadableFile("is empty")
    _refuse_header(lines[0])
    stamps, values = zip(*(_parse(number, line) for number, line in enumerate(lines, 1)), strict=True)
    seconds = np.array([(stamp - stamps[0]).total_seconds() for stamp in stamps])
    back = np.flatnonzero(np.diff(seconds) < 0)
    if len(back):
        raise UnreadableFile(f"line {back[0] + 2}: goes back in time")
    if seconds[-1] > _LONGEST:
        raise UnreadableFile(f"lasts {seconds[-1]:,.0f} s by its stamps, more than {_LONGEST:.0f} s")
    _, first = np.unique(seconds, return_index=True)
    return Stream(seconds[first], np.array(values)[first])


def resample(stream: Stream, rate: float, steps: int, *, angles: bool = False) -> np.ndarray:
    """(steps, 3) float32: readings at 0, 1 / rate, ... seconds, linear between neighbours, NaN after the end.

    With ``angles``, in degrees, the shorter way round: between 359 and 1 lies 0, not 180.
    """
    count = min(steps, stream.steps(rate))
    times = np.arange(count) / rate
    values = np.unwrap(stream.values, axis=0, period=_ROUND) if angles else stream.values
    sampled = np.full((steps, WIDTH), np.nan, np.float32)
    for channel in range(WIDTH):
        sampled[:count, channel] = np.interp(times, stream.seconds, values[:, channel])
    if angles:
        closest = np.abs(times[:, None] - stream.seconds).argmin(axis=1)
        sampled[:count] -= _ROUND * np.round((values - stream.values)[closest] / _ROUND)
    return sampled


def _refuse_header(line: str) -> None:
    fields = line.split(",")[1:]
    if fields and all(math.isnan(_number(field)) for field in fields):
        raise UnreadableFile(f"line 1 is a header ('{_shown(line)}'), published files have none")


def _parse(number: int, line: str) -> tuple[datetime, list[float]]:
    fields = line.split(",")
    if len(fields) != 1 + WIDTH:
        raise UnreadableFile(f"line {number}: has {len(fields)} values, expected {1 + WIDTH} (time, x, y, z)")
    try:
        stamp = datetime.fromisoformat(fields[0].strip()).replace(tzinfo=None)
    except ValueError as error:
        raise UnreadableFile(f"line {number}: '{_shown(fields[0])}' is no time like {_EXAMPLE}") from error
    values = [_number(field) for field in fields[1:]]
    for field, value in zip(fields[1:], values, strict=True):
        if not abs(value) < _HIGHEST:
            raise UnreadableFile(f"line {number}: '{_shown(field)}' is no finite number")
    return stamp, values


def _number(field: str) -> float:
    """NaN where it is none."""
    try:
        return float(field)
    except ValueError:
        return math.nan


def _shown(text: str) -> str:
    line = " ".join(text.split())
    return line if len(line) <= 40 else f"{line[:39]}…"
