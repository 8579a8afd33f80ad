"""Arrays in ``.npy`` form inside gzip files, read from the front and never unzipped as a whole."""

from __future__ import annotations

import gzip
import zlib
from math import prod
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np

from repdib_lightning.errors import UserError

_DAMAGE = (OSError, EOFError, zlib.error)
_PART = 2**20


class ArrayStream:
    """One array on disk, whose rows are read or passed over in their order. Use as a context manager.

    Args:
        path: the file.

    Attributes:
        path: the file.
        shape: (n, ...) of the whole array.
        dtype: of its elements.
        row: the next row to be read.

    Raises:
        UserError: naming the file: not there, not gzip, not ``.npy`` inside, or truncated.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.row = 0
        try:
            self._file = gzip.open(path, "rb")  # noqa: SIM115, see close()
        except OSError as error:
            raise UserError(f"{path}: cannot be read ({error.strerror or error})") from error
        try:
            self.shape, self.dtype = self._read_header()
        except BaseException:
            self._file.close()
            raise

    def _read_header(self) -> tuple[tuple[int, ...], np.dtype[Any]]:
        try:
            version = np.lib.format.read_magic(self._file)
            if version not in ((1, 0), (2, 0)):
                raise UserError(f"{self.path}: holds an array of .npy version {version}, must be (1, 0) or (2, 0)")
            read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
            shape, by_columns, dtype = read(self._file)
        except _DAMAGE as error:
            raise self._damaged(error, "within its first bytes") from error
        except UserError:
            raise
        except Exception as error:  # a header is a Python literal, and damage to one has been seen to raise many kinds
            told = "is empty" if not self.path.stat().st_size else "the gzip file holds no .npy array"
            raise UserError(f"{self.path}: {told} ({type(error).__name__} in its header)") from error
        if min(shape, default=0) < 0:
            raise UserError(f"{self.path}: the gzip file holds no .npy array (shape {shape})")
        if by_columns and len(shape) > 1:
            raise UserError(f"{self.path}: the array lies column by column (Fortran order), must lie row by row")
        return shape, dtype

    def skip(self, rows: int) -> None:
        """Pass over rows.

        Raises:
            UserError: naming the file: it is truncated or damaged.
        """
        left = rows * self._width
        while left:
            left -= len(self._part(min(left, _PART), rows - left // self._width))
        self.row += rows

    def read(self, into: np.ndarray) -> None:
        """Fill a contiguous array with the next rows: (k, ...) of the stream's own type.

        Raises:
            UserError: naming the file: it is truncated or damaged.
        """
        assert into.dtype == self.dtype and into.shape[1:] == self.shape[1:]
        room = into.reshape(-1).view(np.uint8).data
        done = 0
        while done < len(room):
            part = self._part(min(len(room) - done, _PART), done // self._width)
            room[done : done + len(part)] = part
            done += len(part)
        self.row += len(into)

    def read_all(self) -> np.ndarray:
        """The whole array (n, ...); the file's checksum is verified, too.

        Raises:
            UserError: naming the file: it is truncated or damaged.
        """
        content = bytearray()  # grows, since nothing says that what a damaged header promises is there
        whole = prod(self.shape) * self.dtype.itemsize
        while len(content) < whole:
            content += self._part(min(whole - len(content), _PART), len(content) // self._width)
        self.row = self.shape[0] if self.shape else 0
        self.check_end()
        return np.frombuffer(content, self.dtype).reshape(self.shape)

    def check_end(self) -> None:
        """Verify the checksum that follows the last row.

        Raises:
            UserError: naming the file.
        """
        try:
            self._file.read(1)
        except _DAMAGE as error:
            raise self._damaged(error, "behind its last row") from error

    @property
    def _width(self) -> int:
        return prod(self.shape[1:]) * self.dtype.itemsize

    def _part(self, size: int, rows: int) -> bytes:
        """At most ``size`` bytes, at least one. ``rows``: those that were read since :attr:`row` was set."""
        where = f"after {self.row + rows:,} of {self.shape[0] if self.shape else 1:,} rows"
        try:
            part = self._file.read(size)
        except _DAMAGE as error:
            raise self._damaged(error, where) from error
        if not part:
            raise UserError(f"{self.path}: truncated (the array ends {where})")
        return part

    def _damaged(self, error: BaseException, where: str) -> UserError:
        if isinstance(error, EOFError):
            return UserError(f"{self.path}: truncated ({where}); get it again")
        if isinstance(error, gzip.BadGzipFile) and "Not a gzipped file" in str(error):
            return UserError(f"{self.path}: is not a gzip file")
        if isinstance(error, OSError) and error.strerror:
            return UserError(f"{self.path}: cannot be read ({error.strerror})")
        return UserError(f"{self.path}: damaged {where} ({str(error).splitlines()[0]}); get it again")

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    def __enter__(self) -> ArrayStream:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()
