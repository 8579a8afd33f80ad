"""The unfinished recording beside a store: found, locked, checked, and gone on with."""

from __future__ import annotations

import fcntl
import os
from pathlib import Path

import h5py

from repdib_lightning.data.files import sync_directory, sync_file
from repdib_lightning.data.row_file import RowFile, make_empty
from repdib_lightning.data.statement import Statement, stated_in
from repdib_lightning.errors import UserError

_UNREADABLE = (OSError, KeyError, RuntimeError, ValueError, TypeError, AttributeError)
_ENDING = ".partial"


def partial_of(path: Path) -> Path:
    """The file that holds a store until it is complete."""
    return path.with_name(f".{path.name}{_ENDING}")


def open_partial(path: Path, statement: Statement, temporary: Path, *, begin_anew: bool) -> RowFile:
    """Open the unfinished recording of a store, or begin one; no other process can until it is closed.

    A new one appears at once with all its arrays: it is made under another name.

    Args:
        path: the store.
        statement: what it shall be.
        temporary: that other name.
        begin_anew: discard an unfinished recording.

    Raises:
        UserError: another process has it open; it was made for another statement; it is damaged; the store itself has
            appeared meanwhile.
        OSError, RuntimeError, ValueError: it cannot be written.
    """
    partial = partial_of(path)
    handle = _locked(partial)
    empty = os.fstat(handle).st_size == 0
    try:
        if path.exists() and not begin_anew:
            raise UserError(f"{path}: exists already; choose another file or pass --overwrite")
        if not empty and not begin_anew:
            return _checked(partial, handle, statement)
        made = _begin(partial, temporary, statement)
    except BaseException:
        if empty:
            partial.unlink(missing_ok=True)
        os.close(handle)
        raise
    os.close(handle)
    return made


def _locked(partial: Path) -> int:
    """Open and lock the file, which is empty if there was none. The lock ends with the process, however that ends."""
    while True:
        handle = os.open(partial, os.O_RDWR | os.O_CREAT, 0o666)
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
            if os.path.samestat(os.fstat(handle), os.stat(partial)):
                return handle
        except FileNotFoundError:
            pass
        except BaseException as error:
            os.close(handle)
            if isinstance(error, BlockingIOError):
                told = f"{partial}: another process is writing this recording; wait for it, or stop it"
                raise UserError(told) from error
            raise
        os.close(handle)  # another process has renamed or replaced the file since it was opened


def _begin(partial: Path, temporary: Path, statement: Statement) -> RowFile:
    try:
        make_empty(temporary, statement)
        handle = os.open(temporary, os.O_RDWR)
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
            rows = RowFile(temporary, handle)
            rows.reserve_episodes()
            sync_file(temporary)
            os.replace(temporary, partial)
            sync_directory(partial.parent)
            rows.path = partial
        except BaseException:
            os.close(handle)
            raise
        return rows
    finally:
        temporary.unlink(missing_ok=True)


def _checked(partial: Path, handle: int, statement: Statement) -> RowFile:
    try:
        with h5py.File(partial, "r", locking=False) as file:
            differing = stated_in(file).differences(statement.facts())
        rows = RowFile(partial, handle)
        rows.lengths()
    except _UNREADABLE as error:
        raise UserError(
            f"{partial}: a damaged unfinished recording ({_first_line(error)}); it cannot go on, "
            "--overwrite begins it anew"
        ) from error
    if differing:
        raise UserError(
            f"{partial}: an unfinished recording with other options: {'; '.join(differing[:3])}; "
            "the same options go on with it, --overwrite begins it anew"
        )
    return rows


def _first_line(error: BaseException) -> str:
    return str(error.args[0] if isinstance(error, KeyError) and error.args else error).partition("\n")[0]


def describe_unfinished(path: Path) -> str | None:
    """One line on an unfinished recording; None for every other file.

    Raises:
        UserError: it is damaged.
    """
    if not (path.name.startswith(".") and path.name.endswith(_ENDING) and path.is_file()):
        return None
    store = path.with_name(path.name[1 : -len(_ENDING)])
    if not path.stat().st_size:
        return f"{path}: an unfinished recording of {store}, nothing of it is written yet"
    try:
        handle = os.open(path, os.O_RDONLY)
        try:
            done = len((rows := RowFile(path, handle)).lengths())
        finally:
            os.close(handle)
    except _UNREADABLE as error:
        raise UserError(f"{path}: a damaged unfinished recording of {store} ({_first_line(error)})") from error
    return (
        f"{path}: an unfinished recording of {store}, {done:,} of {rows.episodes:,} episodes; "
        "the command that began it goes on with it"
    )
