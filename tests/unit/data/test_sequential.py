"""Reading in order decodes each chunk once and holds one row of chunks."""

from __future__ import annotations

from pathlib import Path

import h5py
import numpy as np
import pytest

from repdib_lightning.data.sequential import SequentialRows


class CountingRows(SequentialRows):
    """Counts what is decoded."""

    def __init__(self, data: h5py.Dataset) -> None:
        super().__init__(data)
        self.decoded: list[tuple[int, int]] = []

    def _decode(self, start: int, stop: int) -> np.ndarray:
        self.decoded.append((start, stop))
        return super()._decode(start, stop)


@pytest.mark.parametrize("step", [3, 8, 10, 25, 100])
def test_values_and_one_decoding_a_chunk(tmp_path: Path, step: int) -> None:
    values = np.arange(200).reshape(100, 2)
    with h5py.File(tmp_path / "rows.h5", "w") as file:
        rows = CountingRows(file.create_dataset("x", data=values, chunks=(8, 1), compression="gzip"))
        read = [rows.read(start, min(start + step, 100)) for start in range(0, 100, step)]
        np.testing.assert_array_equal(np.concatenate(read), values)
        assert rows.decoded == [(start, start + 8) for start in range(0, 100, 8)]


def test_contiguous_rows_are_read_as_asked(tmp_path: Path) -> None:
    with h5py.File(tmp_path / "rows.h5", "w") as file:
        rows = CountingRows(file.create_dataset("x", data=np.arange(10)))
        assert rows.read(3, 6).tolist() == [3, 4, 5]
        assert rows.decoded == [(3, 6)]
