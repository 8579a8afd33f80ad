"""Rows of a store that is still being written."""

from __future__ import annotations

import mmap
from collections.abc import Mapping

import numpy as np

from repdib_lightning.data.episode_checks import Column
from repdib_lightning.data.row_file import RowFile

_RESIDENT = 2**28
"""Bytes that may be mapped before they are given back; they stay in the page cache."""

_HUGE = 2**21
"""Bytes that the system may map for a row, however small: a huge page."""


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
        self._mapped_bytes = 0

    def _array(self, column: Column, offset: int, width: int, rows: int) -> np.ndarray:
        flat = np.frombuffer(self._whole, np.dtype(column.stored_dtype), rows * width // _size(column), offset)
        return flat.reshape(rows, *column.stored_shape)

    def gather(self, key: str, rows: np.ndarray) -> np.ndarray:
        """Copy the given rows of one key, in any order and with repeats: (n,) int64 -> (n, ...)."""
        array = self._arrays[key]
        found = np.empty((len(rows), *array.shape[1:]), array.dtype)
        mapped = max(_HUGE, array[:1].nbytes)
        at_once = max(1, _RESIDENT // mapped)
        for first in range(0, len(rows), at_once):
            part = rows[first : first + at_once]
            found[first : first + at_once] = array[part]
            self._mapped_bytes += min(mapped * len(part), array.nbytes)
            if self._mapped_bytes > _RESIDENT:
                self._mapped_bytes = 0
                self._whole.madvise(mmap.MADV_DONTNEED)
        return found


def _size(column: Column) -> int:
    return np.dtype(column.stored_dtype).itemsize
