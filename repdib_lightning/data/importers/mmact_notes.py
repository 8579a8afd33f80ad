"""What an import did not take as it was: collected while it reads, and kept over interruptions."""

from __future__ import annotations

import json
import os
from collections.abc import Sequence
from dataclasses import astuple, dataclass
from pathlib import Path
from typing import Literal

from repdib_lightning.data.files import whole_file
from repdib_lightning.errors import UserError


class UnreadableFile(Exception):
    """Why a file gives nothing, in words that follow its name."""


@dataclass(frozen=True)
class Note:
    """One line: what happened, to which file or trial, and why.

    ``skipped``: the file is treated as if it were not there; ``broken``: what comes before the damage is used;
    ``short``: a video has fewer frames than are kept of each; ``left out``: a trial of which nothing can be read.
    """

    kind: Literal["skipped", "broken", "short", "left out"]
    what: str
    why: str

    def __str__(self) -> str:
        return f"{self.kind} {self.what}: {self.why}"

    def check(self) -> None:
        """Raise UserError if a file cannot be used as it is."""
        if self.kind in ("skipped", "broken"):
            raise UserError(f"{self.what}: {self.why}; without --strict it is passed over and told at the end")


class NoteLog:
    """Notes on the episodes that are written, in a file beside the store until that is complete.

    Args:
        output: the store.
        done: episodes that earlier, interrupted imports have written; their notes are read again, others forgotten.
    """

    def __init__(self, output: Path, done: int) -> None:
        self._path = output.with_name(f".{output.name}.notes")
        self._lines = [line for line in self._read() if line[0] < done]
        if self._lines:
            with whole_file(self._path) as aside:
                aside.write_text("".join(f"{json.dumps(line)}\n" for line in self._lines), encoding="utf-8")
        else:
            self._path.unlink(missing_ok=True)

    def add(self, episode: int, notes: Sequence[Note]) -> None:
        """Keep the notes on an episode that is about to be written; they are on the disk before it is."""
        lines = [(episode, *astuple(note)) for note in notes]
        self._lines += lines
        if lines:
            try:
                with open(self._path, "a", encoding="utf-8") as file:
                    file.write("".join(f"{json.dumps(line)}\n" for line in lines))
                    file.flush()
                    os.fsync(file.fileno())
            except OSError as error:
                raise UserError(f"{self._path}: cannot be written ({error.strerror or error})") from error

    @property
    def notes(self) -> list[Note]:
        """All notes, in the order of the episodes."""
        return [Note(*line[1:]) for line in self._lines]

    def remove(self) -> None:
        """Delete the file."""
        self._path.unlink(missing_ok=True)

    def _read(self) -> list[tuple]:
        lines = self._path.read_text(encoding="utf-8").splitlines() if self._path.is_file() else []
        read = []
        for line in lines:
            try:
                read.append(tuple(json.loads(line)))
            except ValueError:  # a power cut in the middle of it: its episode is not written
                break
        return read
