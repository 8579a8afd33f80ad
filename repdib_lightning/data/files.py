"""Files that are either whole or absent: write aside, flush to disk, rename."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from stat import S_IMODE

from repdib_lightning.errors import UserError


def sync_directory(folder: Path) -> None:
    """Flush a folder's entries to disk, so that a rename in it survives a power cut."""
    handle = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def sync_file(path: Path) -> None:
    """Flush one file's content to disk."""
    with open(path, "rb") as handle:
        os.fsync(handle.fileno())


def write_at(handle: int, content: bytes | memoryview, offset: int) -> None:
    """Write all of it at a place of an open file. Raises OSError, such as a full disk."""
    rest = memoryview(content)
    while len(rest):
        written = os.pwrite(handle, rest, offset)
        rest, offset = rest[written:], offset + written


def read_at(handle: int, size: int, offset: int) -> bytearray:
    """Read ``size`` bytes from a place of an open file. Raises OSError if there are fewer."""
    content = bytearray(size)
    rest = memoryview(content)
    while len(rest):
        count = os.preadv(handle, [rest], offset)
        if not count:
            raise OSError(f"ends at byte {offset}, {len(rest)} bytes more were expected")
        rest, offset = rest[count:], offset + count
    return content


@contextmanager
def whole_file(path: Path) -> Iterator[Path]:
    """Yield a temporary path in the target's own folder; on success it becomes ``path``, on error it vanishes.

    Raises:
        UserError: the folder cannot be written to, or the disk is full.
    """
    temporary = path.with_name(f".{path.name}.tmp-{os.getpid()}")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        try:
            temporary.touch()
            mode = S_IMODE(temporary.stat().st_mode)  # of any new file; some libraries make theirs unreadable to others
            yield temporary
            temporary.chmod(mode)
            sync_file(temporary)
            os.replace(temporary, path)
            sync_directory(path.parent)
        finally:
            temporary.unlink(missing_ok=True)
    except OSError as error:
        raise UserError(f"{path}: cannot be written ({error.strerror or error})") from error
