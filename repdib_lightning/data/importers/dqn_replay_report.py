"""Tells at the end of an import of DQN-replay logs what the store holds, and what was left out."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from repdib_lightning.data.importers.dqn_replay_selection import Piece
from repdib_lightning.word_lists import in_ranges


@dataclass(frozen=True)
class LeftOut:
    """Rows of the log that the store lacks, though a selection was to take them or came upon them.

    Attributes:
        padding: rows that no one played, before the episodes that are taken.
        without_end, without_end_rows: pieces whose end the checkpoint does not hold, and their rows.
        given_up, given_up_rows: checkpoints in which a visit would have passed the last row to be read, and the rows
            that no visit took.
        older: rows behind the writing position, of an earlier round of the memory.
    """

    padding: int
    without_end: int
    without_end_rows: int
    given_up: int
    given_up_rows: int
    older: int


def summary(
    output: Path,
    pieces: Sequence[Piece],
    game: str,
    held_out: int,
    *,
    wanted: int | None,
    mid_episode: int,
    left_out: LeftOut,
) -> list[str]:
    """Lines for the user: one on the store, one on what was left out, one where there is less than wanted.

    Args:
        output: the store.
        pieces: what it holds.
        game: as ALE names it.
        held_out: episodes for evaluation.
        wanted: transitions that were asked for; None for all.
        mid_episode: episodes whose beginning is not in their checkpoint.
        left_out: rows that are not in the store.
    """
    transitions = sum(piece.actions for piece in pieces)
    checkpoints = in_ranges(sorted({piece.checkpoint for piece in pieces}))
    told = f"{output}: {transitions:,} transitions of {game} in {len(pieces):,} episodes of checkpoints {checkpoints}"
    lines = [f"{told}; {held_out:,} episodes for evaluation, {mid_episode:,} begin in mid-episode"]
    without = {
        f"{left_out.padding:,} rows of padding before episodes": left_out.padding,
        f"{left_out.without_end:,} pieces without an end ({left_out.without_end_rows:,} rows)": left_out.without_end,
        f"what visits left of {left_out.given_up:,} checkpoints ({left_out.given_up_rows:,} rows)": left_out.given_up,
        f"{left_out.older:,} rows of an earlier round": left_out.older,
    }
    if any(without.values()):
        lines.append("left out: " + "; ".join(words for words, count in without.items() if count))
    logged = sum(piece.logged for piece in pieces)
    if wanted is not None and logged < wanted:
        lines.append(f"fewer transitions than asked for: there are {logged:,} of {wanted:,}, padding included")
    return lines
