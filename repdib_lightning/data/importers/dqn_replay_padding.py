"""The rows that Dopamine's replay memory writes before each episode: black frames that no one saw, action 0, reward 0.

There is one less than the frames that are stacked: three in the published logs. Whether a log has them is seen once, at
the first episode that begins within a checkpoint; that the others have them is checked while they are read.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from repdib_lightning.data.importers.dqn_replay_files import ReplayLogs, Steps
from repdib_lightning.data.importers.dqn_replay_selection import Piece
from repdib_lightning.errors import UserError

ROWS = 3


def is_padded(logs: ReplayLogs, pieces: Sequence[Piece]) -> bool:
    """Whether the first row after an end, at the earliest place that is read anyway, begins three rows of padding.

    Where no episode begins within a checkpoint, row 0 of one is looked at.

    Raises:
        UserError: naming the file: the frames cannot be read that far.
    """
    within = [piece for piece in pieces if piece.start and piece.logged > ROWS]
    place = min(within or pieces, key=lambda piece: (piece.start, piece.checkpoint))
    return _black_rows(logs, place, logs.steps(place.checkpoint)) == ROWS


def with_padding(logs: ReplayLogs, pieces: Sequence[Piece], steps: Steps) -> list[Piece]:
    """The pieces of one checkpoint of a padded log, each with its padding stated.

    Row 0 may lie within a padding, so that it is looked at there; elsewhere all three rows are.

    Raises:
        UserError: an episode begins otherwise, or the frames cannot be read.
    """
    stated = []
    for piece in pieces:
        padding = ROWS if piece.start else _black_rows(logs, piece, steps)
        rows = slice(piece.start, piece.start + padding)
        if piece.logged < padding + piece.ended or steps.actions[rows].any() or steps.rewards[rows].any():
            raise _differs(logs, piece)
        stated.append(replace(piece, padding=padding))
    return stated


def check_black(logs: ReplayLogs, piece: Piece, frames: np.ndarray) -> None:
    """Refuse a padding (``piece.padding``, size, size) in which something is seen.

    Raises:
        UserError: naming file and row.
    """
    if frames.any():
        raise _differs(logs, piece)


def _differs(logs: ReplayLogs, piece: Piece) -> UserError:
    return UserError(
        f"{logs.path('observation', piece.checkpoint)}: the episode from row {piece.start:,} on does not begin with "
        f"{ROWS} rows of padding (black, action 0, reward 0) as another does; --padding keep takes every row as it is"
    )


def _black_rows(logs: ReplayLogs, piece: Piece, steps: Steps) -> int:
    """How many of the first three rows of a piece are padding, at most all but one."""
    most = min(ROWS, piece.logged - 1)
    if most < 1:
        return 0
    with logs.frames(piece.checkpoint) as stream:
        stream.skip(piece.start)
        frames = np.empty((most, *stream.shape[1:]), np.uint8)
        stream.read(frames)
    rows = slice(piece.start, piece.start + most)
    seen = frames.any((1, 2)) | (steps.actions[rows] != 0) | (steps.rewards[rows] != 0)
    return int(seen.argmax()) if seen.any() else most
