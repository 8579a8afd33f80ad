"""Snapshots of explorations that a suite fine-tunes from, as its file lists them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from repdib_lightning.errors import UserError
from repdib_lightning.experiments.suite import EXPLORATION, SNAPSHOTS, explores

ALL, MONOTONE = "all", "monotone"
"""``AGENT/NAME/monotone`` is of one fine-tuning, ``AGENT/all/monotone`` the mean over all of them."""


def read_snapshots(file: Path, key: str, given: Any) -> tuple[int, ...]:
    """Frames as a file lists them, ascending; none for None. Raises UserError if it is no such list."""
    if given is None:
        return ()
    if not isinstance(given, list) or not all(type(count) is int and count > 0 for count in given):
        raise UserError(f"{file}: {key} must list frames, such as [5000, 10000], is {given!r:.60}")
    if len(set(given)) < len(given):
        raise UserError(f"{file}: {key} names a snapshot twice: {given}")
    return tuple(sorted(given))


def check_names(file: Path, key: str, names: Sequence[str], frames: Sequence[int]) -> None:
    """Check that no run has the name of another one's snapshot, or of the mean over all of them.

    Raises:
        UserError: naming both.
    """
    if frames and ALL in names:
        raise UserError(f"{file}: {key}: '{ALL}' is what the mean over all runs is called; take another name")
    for name in names:
        for count in frames:
            if f"{name}_{count}" in names:
                raise UserError(
                    f"{file}: {key}: '{name}_{count}' is also what '{name}' from snapshot {count} is called; take "
                    "another name"
                )


def check_snapshots(file: Path, key: str, frames: Sequence[int], place: str, merged: Mapping[str, Any]) -> None:
    """Check that an exploration writes what is fine-tuned from.

    Args:
        file, key: of the list. frames: what it says. place: of the setting. merged: the setting's configuration.

    Raises:
        UserError: the setting does not explore, its configuration lists no snapshots, or not this one.
    """
    if not frames:
        return
    if not explores(merged):
        raise UserError(f"{file}: {key}: '{place}' does not explore (its data are no {EXPLORATION}); leave them out")
    data = merged["data"]
    written = {**data, **data.get("init_args", {})}.get(SNAPSHOTS) if isinstance(data, Mapping) else None
    if not isinstance(written, list):
        raise UserError(f"{file}: {key}: '{place}' does not say which it writes; add data.{SNAPSHOTS}: {list(frames)}")
    for count in frames:
        if count not in written:
            known = ", ".join(map(str, written)) or "none"
            raise UserError(f"{file}: {key}: '{place}' writes no snapshot {count}, its data.{SNAPSHOTS} are {known}")
