"""V-D4RL at 84 px: compressed HDF5 shards, many episodes one after the other.

Keys: observation (N, 3, 84, 84) uint8 un-stacked, action (N, A), reward (N,), discount (N,), step_type (N,): 0 first,
1 middle, 2 last row of an episode. A set may be split at any row, so an episode may go on in the next shard.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import h5py
import numpy as np
from tqdm import tqdm

from repdib_lightning.data.importers.file_order import natural_key
from repdib_lightning.data.importers.recorded import (
    RecordedEpisode,
    RecordedShape,
    check_early_end,
    check_finite,
    check_image,
    numbers,
)
from repdib_lightning.data.schema import FORMAT
from repdib_lightning.data.sequential import SequentialRows
from repdib_lightning.errors import UserError

_KEYS = ("observation", "action", "reward", "discount", "step_type")
_FIRST, _LAST = 0, 2


@dataclass(frozen=True)
class _Piece:
    """Rows [start, stop) of one shard: an episode, or the part of it that this shard holds."""

    file: Path
    start: int
    stop: int


class Shards:
    """Episodes in the order of the shards, joined where a shard ends within one. The first pass decodes no picture.

    Args:
        files: shards in order.
        progress: show a progress bar over the first pass.

    Raises:
        UserError: naming file, and key or row.
    """

    def __init__(self, files: list[Path], *, progress: bool = False) -> None:
        self._episodes: list[list[_Piece]] = []
        unfinished: list[_Piece] = []
        expected: tuple[tuple[int, ...], int] | None = None
        for file in tqdm(files, desc="check", unit="file", disable=not progress):
            with _open(file) as shard:
                found = (shard.image, shard.actions.shape[1])
                expected = expected or found
                if found != expected:
                    raise UserError(
                        f"{file}: pictures (C, H, W) and action width are {found}, {files[0].name} has {expected}"
                    )
                for start, stop in _cuts(shard.step_types):
                    piece = _Piece(file, start, stop)
                    _check_start(shard, piece, unfinished[-1] if unfinished else None)
                    _check_values(shard, piece, continues=bool(unfinished))
                    unfinished.append(piece)
                    if shard.step_types[stop - 1] == _LAST:
                        self._episodes.append(unfinished)
                        unfinished = []
        if unfinished:
            raise _cut(unfinished[-1], "it is the last shard")
        assert expected is not None
        rows = sum(piece.stop - piece.start for episode in self._episodes for piece in episode)
        self.shape = RecordedShape(len(self._episodes), rows, *expected)

    def episodes(self) -> Iterator[RecordedEpisode]:
        """One episode after the other; a shard is open while its rows are read."""
        rows: list[RecordedEpisode] = []
        pieces = [(piece, piece is episode[-1]) for episode in self._episodes for piece in episode]
        position = 0
        while position < len(pieces):
            file = pieces[position][0].file
            with _open(file) as shard:
                while position < len(pieces) and pieces[position][0].file == file:
                    piece, ends = pieces[position]
                    rows.append(shard.read(piece))
                    if ends:
                        yield _join(rows)
                        rows = []
                    position += 1


class _Shard:
    """One open file whose small arrays are in memory."""

    def __init__(self, path: Path, file: h5py.File) -> None:
        if file.attrs.get("format") == FORMAT:
            raise UserError(f"{path}: is a store of this package already; nothing to import")
        for key in _KEYS:
            if not isinstance(file.get(key), h5py.Dataset):
                raise UserError(f"{path}: key '{key}' is missing (it holds: {', '.join(file) or 'nothing'})")
        data = file["observation"]
        check_image(path, "observation", data.shape, data.dtype, channels_axis=1)
        self.path, self.image = path, tuple(data.shape[1:])
        self._images = SequentialRows(data)
        if len(data) == 0:
            raise UserError(f"{path}: 'observation' has no rows")
        whole = {key: SequentialRows(file[key]).read(0, len(file[key])) for key in _KEYS[1:]}
        self.actions = numbers(path, "action", whole["action"], len(data), width=True)
        self.rewards = numbers(path, "reward", whole["reward"], len(data))
        self.discounts = numbers(path, "discount", whole["discount"], len(data))
        self.step_types = numbers(path, "step_type", whole["step_type"], len(data))
        wrong = np.flatnonzero(~np.isin(self.step_types, (0, 1, 2)))
        if len(wrong):
            raise UserError(
                f"{path}: 'step_type' is {self.step_types[wrong[0]]:g} at row {wrong[0]}, must be 0, 1 or 2"
            )

    def read(self, piece: _Piece) -> RecordedEpisode:
        rows = slice(piece.start, piece.stop)
        images = self._images.read(piece.start, piece.stop)
        return RecordedEpisode(images, self.actions[rows], self.rewards[rows], self.discounts[rows])


@contextmanager
def _open(path: Path) -> Iterator[_Shard]:
    try:
        file = h5py.File(path, "r")
    except OSError as error:
        reason = "truncated" if "truncated" in str(error) else "not a readable HDF5 file"
        raise UserError(f"{path}: {reason} ({str(error).splitlines()[0]})") from error
    with file:
        yield _Shard(path, file)


def _cuts(step_types: np.ndarray) -> Iterator[tuple[int, int]]:
    """Row ranges [start, stop) that end after each last row, and where the shard ends."""
    start = 0
    for stop in sorted({*(np.flatnonzero(step_types == _LAST) + 1).tolist(), len(step_types)}):
        yield start, stop
        start = stop


def _check_start(shard: _Shard, piece: _Piece, before: _Piece | None) -> None:
    """A piece opens an episode, or goes on with the one that the shard before it left unfinished."""
    file, start, types = piece.file, piece.start, shard.step_types
    opens = types[start] == _FIRST
    if before is not None and opens:
        raise _cut(before, f"{file.name} opens a new one")
    if before is None and not opens:
        raise UserError(
            f"{file}: row {start} is in the middle of an episode (step_type {types[start]:g}) and no shard before it "
            "holds its beginning; add the missing shard, or move this one away"
        )
    if before is not None and not _follows(before.file, file):
        raise UserError(
            f"{file}: row {start} is in the middle of an episode, and {before.file.name} need not be the shard before "
            "it; add the missing shard, or rename both to consecutive numbers"
        )
    again = np.flatnonzero(types[start + 1 : piece.stop] == _FIRST)
    if len(again):
        row = start + 1 + int(again[0])
        raise UserError(f"{file}: an episode starts at row {row} before the one from row {start} has ended")


def _follows(before: Path, after: Path) -> bool:
    """Whether two names count up by one at the first place where they differ; names without numbers are trusted."""
    pairs = list(zip(natural_key(before.name), natural_key(after.name), strict=False))
    for (_, left), (_, right) in pairs:
        if left != right:
            return right == left + 1 if isinstance(left, int) and isinstance(right, int) else True
    return True


def _cut(piece: _Piece, reason: str) -> UserError:
    return UserError(
        f"{piece.file}: ends at row {piece.stop - 1} in the middle of an episode, and {reason}; "
        "add the missing shard, or move this one away"
    )


def _check_values(shard: _Shard, piece: _Piece, *, continues: bool) -> None:
    """Row 0 of an episode is void, the first row of its continuation is not: look one row back there."""
    rows = slice(piece.start, piece.stop)
    values = {"action": shard.actions[rows], "reward": shard.rewards[rows], "discount": shard.discounts[rows]}
    first = piece.start
    if continues:
        first -= 1
        values = {key: np.concatenate([array[:1] * 0, array]) for key, array in values.items()}
    elif piece.stop - piece.start == 1 and shard.step_types[piece.start] == _LAST:
        raise UserError(f"{shard.path}: the episode at row {piece.start} has one row and holds no action")
    check_finite(shard.path, first, values)
    ends = shard.step_types[piece.stop - 1] == _LAST
    check_early_end(shard.path, first, values["discount"] if ends else np.append(values["discount"], 1))


def _join(pieces: list[RecordedEpisode]) -> RecordedEpisode:
    if len(pieces) == 1:
        return pieces[0]
    return RecordedEpisode(
        np.concatenate([piece.images for piece in pieces]),
        np.concatenate([piece.actions for piece in pieces]),
        np.concatenate([piece.rewards for piece in pieces]),
        np.concatenate([piece.discounts for piece in pieces]),
    )
