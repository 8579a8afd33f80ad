"""Checkpoint files on disk: their names, the digest that proves them whole, and the newest good one of a run.

A checkpoint is torch's ordinary zip archive; a sha256 over everything that torch wrote stands in the archive's comment
field. File and digest are therefore one file that one rename puts in place: at no moment can they disagree, and
``torch.load`` or any zip reader still opens it. Nothing here imports torch or Lightning.
"""

from __future__ import annotations

import hashlib
import os
import re
import struct
import sys
from pathlib import Path
from typing import BinaryIO

from repdib_lightning.errors import UserError, nearest

FOLDER = "checkpoints"
"""Where in a run's folder its checkpoints lie."""

_NAME = re.compile(r"step-(\d{8,})\.ckpt")
_TEMPORARY = re.compile(r"\..+\.tmp-(\d+)")
_LABEL = b"repdib sha256 "
_COMMENT_LENGTH = len(_LABEL) + 64
_NO_COMMENT = b"\0\0"  # the length field that ends the archive as torch wrote it
_BLOCK = 1 << 20


class DigestingFile:
    """A write-only file that hashes what passes through it and remembers why a write failed.

    torch turns an OSError of a file object into a RuntimeError about archive positions; ``error`` keeps the cause.
    """

    def __init__(self, handle: BinaryIO) -> None:
        self.error: OSError | None = None
        self._handle, self._digest = handle, hashlib.sha256()

    def write(self, data: bytes) -> int:
        """Write and hash. Raises OSError."""
        try:
            written = self._handle.write(data)
        except OSError as error:
            self.error = error
            raise
        self._digest.update(data)
        return written

    def flush(self) -> None:
        """Hand what is buffered to the operating system. Raises OSError."""
        self._handle.flush()

    def seal(self) -> None:
        """Put the digest into the archive's comment field. Raises OSError."""
        self._handle.seek(-len(_NO_COMMENT), os.SEEK_END)
        self._handle.write(struct.pack("<H", _COMMENT_LENGTH) + _LABEL + self._digest.hexdigest().encode())
        self._handle.flush()


def damage(path: Path) -> str | None:
    """Say what is wrong with a checkpoint file, or return None when every byte is as it was written."""
    try:
        with open(path, "rb") as handle:
            return _damage(handle)
    except OSError as error:
        return (error.strerror or str(error)).lower()


def _damage(handle: BinaryIO) -> str | None:
    ending = len(_NO_COMMENT) + _COMMENT_LENGTH
    left = handle.seek(0, os.SEEK_END) - ending
    if left <= 0:
        return "it is cut short"
    handle.seek(left)
    tail = handle.read(ending)
    if not tail.startswith(struct.pack("<H", _COMMENT_LENGTH) + _LABEL):
        return "it does not end in a digest: cut short, or not written by this package"
    handle.seek(0)
    digest = hashlib.sha256()
    while left > 0 and (block := handle.read(min(_BLOCK, left))):
        digest.update(block)
        left -= len(block)
    digest.update(_NO_COMMENT)
    written = tail[len(_NO_COMMENT) + len(_LABEL) :]
    return None if digest.hexdigest().encode() == written else "its content does not match its digest"


def step_path(folder: Path, step: int) -> Path:
    """Name of the checkpoint after ``step`` optimiser steps in a folder of checkpoints."""
    return folder / f"step-{step:08d}.ckpt"


def step_of(path: Path) -> int:
    """Optimiser steps that a checkpoint's name states."""
    match = _NAME.fullmatch(path.name)
    assert match, path
    return int(match[1])


def listed(folder: Path) -> list[Path]:
    """Checkpoints of a folder of checkpoints, newest first; damaged ones included."""
    if not folder.is_dir():
        return []
    return sorted((path for path in folder.iterdir() if _NAME.fullmatch(path.name)), key=step_of, reverse=True)


def last_good(run: Path) -> Path:
    """Return the newest checkpoint that is whole, and warn on standard error of each damaged one that was passed over.

    Args:
        run: a run's folder, its folder of checkpoints, or one checkpoint.

    Raises:
        UserError: there is none, or the one that was named is missing or damaged.
    """
    if run.suffix == ".ckpt":
        check(run)
        return run
    folder = run / FOLDER if (run / FOLDER).is_dir() else run
    candidates = listed(folder)
    damaged: list[str] = []
    for path in candidates:
        if (reason := damage(path)) is None:
            print(*damaged, sep="", end="", file=sys.stderr)
            return path
        damaged.append(f"warning: {path}: damaged checkpoint passed over ({reason})\n")
    if candidates:
        raise UserError(f"{folder}: all {len(candidates)} checkpoints are damaged, nothing to resume from")
    raise UserError(f"{folder}: no checkpoint to resume from; remove the folder and start the run again")


def check(path: Path) -> None:
    """Raise UserError, with the nearest name or what is wrong, unless the checkpoint exists and is whole."""
    if not path.is_file():
        others = [other.name for other in listed(path.parent)]
        raise UserError(f"{path}: no such checkpoint; {nearest(path.name, others) or 'its folder holds none'}")
    if (reason := damage(path)) is not None:
        raise UserError(f"{path}: damaged checkpoint ({reason}); name the run's folder to use the one before it")


def sweep_temporaries(folder: Path) -> None:
    """Remove what writers that are no longer alive left half-written in a folder."""
    if not folder.is_dir():
        return
    for path in folder.iterdir():
        match = _TEMPORARY.fullmatch(path.name)
        if match and (int(match[1]) == os.getpid() or not is_alive(int(match[1]))):
            path.unlink(missing_ok=True)


def is_alive(pid: int) -> bool:
    """Whether a process of this machine exists."""
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except PermissionError:
        return True
    return True
