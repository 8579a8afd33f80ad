"""A store's file while its rows are written.

HDF5 makes the file with all its arrays, and is closed before the first row. From then on bytes are written at fixed
places, so that the file is readable whenever the process is killed, and a failed write leaves nothing in a cache.
"""

from __future__ import annotations

import fcntl
import mmap
import os
from collections.abc import Sequence
from pathlib import Path

import h5py
import numpy as np

from repdib_lightning.data.files import read_at, write_at
from repdib_lightning.data.schema import FORMAT, SCHEMA_VERSION
from repdib_lightning.data.statement import Statement

# As long as a fingerprint; it is overwritten in place. HDF5 keeps text outside of what it checks by checksums.
UNFINISHED = "unfinished" + "." * 22
_HEAD = 2**16


def make_empty(path: Path, statement: Statement) -> None:
    """Make a store without rows: every array at its final place, every attribute but the fingerprint final.

    Raises:
        OSError, RuntimeError, ValueError: it cannot be written, or HDF5 has a limit, such as 64 KiB an attribute.
    """
    with h5py.File(path, "w") as file:
        file.attrs["fingerprint"] = UNFINISHED  # first, so that it lies near the beginning of the file
        file.attrs.update({"format": FORMAT, "schema_version": SCHEMA_VERSION, **statement.attributes})
        for key, column in statement.columns.items():
            data = _dataset(file, key, (statement.rows, *column.stored_shape), column.stored_dtype)
            data.attrs.update(statement.attributes_of(key))
        for name in ("start", "length", *(["recording"] if statement.recordings else [])):
            _dataset(file, f"episodes/{name}", (statement.episodes,), "int64")
        _dataset(file, "episodes/evaluation", (statement.episodes,), "bool")


def _dataset(file: h5py.File, name: str, shape: tuple[int, ...], dtype: str) -> h5py.Dataset:
    """A contiguous data set whose place in the file is fixed now, so that it can be memory-mapped."""
    layout = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
    layout.set_layout(h5py.h5d.CONTIGUOUS)
    layout.set_alloc_time(h5py.h5d.ALLOC_TIME_EARLY)
    layout.set_fill_time(h5py.h5d.FILL_TIME_NEVER)
    layout.set_obj_track_times(False)
    parent = file.require_group(name.rpartition("/")[0] or "/")
    leaf = name.rpartition("/")[2].encode()
    space = h5py.h5s.create_simple(shape)
    kind = h5py.h5t.py_create(np.dtype(dtype), logical=True)
    return h5py.Dataset(h5py.h5d.create(parent.id, leaf, kind, space, layout))


class RowFile:
    """Rows and episodes of a file of :func:`make_empty`, written in place.

    An episode is in the file once its length is: the length is written last, and is 0 until then.

    Attributes:
        rows, episodes: N and E, as stated.

    Args:
        path: the file.
        handle: of the same file, open to read and write; closed by :meth:`close`.

    Raises:
        OSError, KeyError: it is no readable store.
    """

    def __init__(self, path: Path, handle: int) -> None:
        self.path = path
        self._handle = handle
        self._places: dict[str, tuple[int, int]] = {}  # offset of the first row, bytes a row
        with h5py.File(path, "r", locking=False) as file:  # whoever holds the handle has locked the file
            self._fingerprint = str(file.attrs["fingerprint"]).encode()
            file.visititems(self._locate)
            self._lengths = file["episodes/length"][:]
            self._starts = file["episodes/start"][:]
            self.episodes = len(self._lengths)
            self.rows = len(file[next(key for key in self._places if not key.startswith("episodes/"))])

    def _locate(self, key: str, item: h5py.Dataset | h5py.Group) -> None:
        if isinstance(item, h5py.Dataset):
            offset = item.id.get_offset()
            if offset is None:
                raise KeyError(f"'{key}' is not contiguous")
            self._places[key] = (offset, int(np.prod(item.shape[1:])) * item.dtype.itemsize)

    def reserve_episodes(self) -> None:
        """Take disk space for the arrays of the episodes, so that no full disk writes half a length."""
        for key, (offset, width) in self._places.items():
            if key.startswith("episodes/"):
                write_at(self._handle, bytes(width * self.episodes), offset)

    def lengths(self) -> np.ndarray:
        """(episodes that were in the file when it was opened,) int64: their rows.

        Raises:
            KeyError: what the file says of its episodes cannot be.
        """
        count = int(np.flatnonzero(self._lengths)[-1]) + 1 if self._lengths.any() else 0
        lengths = self._lengths[:count]
        ends = np.cumsum(lengths)
        if count and (lengths.min() < 1 or ends[-1] > self.rows or (self._starts[:count] != ends - lengths).any()):
            raise KeyError("its episodes do not follow each other")
        return lengths

    def forget_after(self, episodes: int) -> None:
        """Let the file hold its first episodes only; their rows may be written again. Raises OSError."""
        forgotten = np.arange(episodes, len(self._lengths))
        if self._lengths[forgotten].any():
            self._lengths[forgotten] = 0
            self.write("episodes/length", episodes, self._lengths[forgotten])
            self.flush()

    def mapped(self, keys: Sequence[str]) -> tuple[mmap.mmap, dict[str, tuple[int, int]]]:
        """The whole file mapped into memory, read-only, and where the arrays lie: offset of row 0, bytes a row."""
        whole = mmap.mmap(self._handle, 0, access=mmap.ACCESS_READ)
        return whole, {key: self._places[key] for key in keys}

    def read(self, key: str, first: int, count: int) -> np.ndarray:
        """Bytes of ``count`` rows: (count, bytes a row) uint8. Raises OSError."""
        offset, width = self._places[key]
        return np.frombuffer(read_at(self._handle, count * width, offset + first * width), np.uint8).reshape(count, -1)

    def write(self, key: str, first: int, array: np.ndarray) -> None:
        """Write rows as they are stored: (n, ...). Raises OSError."""
        offset, width = self._places[key]
        assert array.nbytes == width * len(array)
        write_at(self._handle, np.ascontiguousarray(array).reshape(-1).view(np.uint8).data, offset + first * width)

    def flush(self) -> None:
        """Return when all that was written is on the disk. Raises OSError."""
        os.fdatasync(self._handle)

    def seal(self, fingerprint: str) -> None:
        """Put the fingerprint in, and flush. Raises OSError."""
        place = read_at(self._handle, min(_HEAD, os.fstat(self._handle).st_size), 0).find(self._fingerprint)
        assert place >= 0 and len(fingerprint) == len(self._fingerprint)
        write_at(self._handle, fingerprint.encode(), place)
        os.fsync(self._handle)
        with h5py.File(self.path, "r", locking=False) as file:
            assert file.attrs["fingerprint"] == fingerprint

    def close(self) -> None:
        """Give the file and its lock back, even where the file is still mapped, which keeps it open."""
        fcntl.flock(self._handle, fcntl.LOCK_UN)
        os.close(self._handle)
