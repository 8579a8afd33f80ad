"""Reads a data set once, front to back: each compressed chunk is decoded once, and memory stays flat."""

from __future__ import annotations

import h5py
import numpy as np

from repdib_lightning.errors import UserError


class SequentialRows:
    """Slices of one HDF5 data set, asked for in ascending order.

    Chunks seldom end where episodes do, and HDF5 decodes a whole chunk for each row that is touched. This keeps the
    last row of chunks, so that a pass over the file costs one decoding of each instead of two or three.

    Args:
        data: the data set, of any layout.
    """

    def __init__(self, data: h5py.Dataset) -> None:
        self._data = data
        self._block_rows = data.chunks[0] if data.chunks else 0
        self._block_start = -1
        self._block = np.empty(0)

    def read(self, start: int, stop: int) -> np.ndarray:
        """Rows [start, stop): (stop - start, ...), a copy.

        Raises:
            UserError: the rows cannot be decoded (damaged chunk, missing compression filter, truncated file).
        """
        if not self._block_rows or start >= stop:
            return self._decode(start, stop)
        pieces = []
        while start < stop:
            base = start - start % self._block_rows
            if base != self._block_start:
                self._block, self._block_start = self._decode(base, base + self._block_rows), base
            end = min(stop, base + self._block_rows)
            pieces.append(self._block[start - base : end - base])
            start = end
        return np.concatenate(pieces)

    def _decode(self, start: int, stop: int) -> np.ndarray:
        try:
            rows: np.ndarray = self._data[start:stop]
        except OSError as error:
            reason = str(error).splitlines()[0]
            name = self._data.name.lstrip("/")
            raise UserError(
                f"{self._data.file.filename}: '{name}' rows {start} to {stop} cannot be read ({reason})"
            ) from error
        return rows
