"""Rows of a store that is still being written."""

from __future__ import annotations

import mmap
from collections.abc import Mapping

import numpy as np

from repdib_lightning.data.episode_checks import Column
from repdib_lightning.data.row_file import RowFile

_RESIDENT = 2**28
"""Bytes that are read before what the system mapped for them is given back; it stays in the page cache."""


class GrowingArrays:
    """Arrays of a file of :class:`~repdib_lightning.data.writer.EpisodeWriter`, mapped into memory while it grows.

    Only rows that were written mean anything. However many are read, the process holds few of them: what was mapped is
    given back now and then, and stays in the system's cache.

    Args:
        file: what the rows are written to. columns: key in the store -> column.
    """

    def __init__(self, file: RowFile, columns: Mapping[str, Column]) -> None:
        self._whole, places = file.mapped(list(columns))
        self._arrays = {key: self._array(columns[key], *places[key], file.rows) for key in columns}
        self._read = 0

    def _array(self, column: Column, offset: int, width: int, rows: int) -> np.ndarray:
        flat = np.frombuffer(self._whole, np.dtype(column.stored_dtype), rows * width // _size(column), offset)
        return flat.reshape(rows, *column.stored_shape)

    def gather(self, key: str, rows: np.ndarray) -> np.ndarray:
        """Copy the given rows of one key, in any order and with repeats: (n,) int64 -> (n, ...)."""
        found: np.ndarray = np.take(self._arrays[key], rows, axis=0)
        self._read += found.nbytes
        if self._read > _RESIDENT:
            self._read = 0
            self._whole.madvise(mmap.MADV_DONTNEED)
        return found


def _size(column: Column) -> int:
    return np.dtype(column.stored_dtype).itemsize
