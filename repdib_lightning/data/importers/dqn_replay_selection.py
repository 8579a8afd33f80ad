"""Which episodes of the checkpoints are taken, decided from their ends alone.

``decision_transformer`` is the 1 % of Chen et al. (Decision Transformer, 2021), drawn as their published code does:

- A visit goes to a checkpoint drawn uniformly, and reads on where the last visit to it stopped, from row 0 at first.
- It takes ``per_visit + 1`` episodes: the counter of that code lets one more pass.
- A visit that would reach row ``read_up_to`` is given up as a whole, the episodes that it has passed included, and so
  is every later one to this checkpoint.
- It ends as soon as there are enough transitions, which the last visit passes.

With numbers 0 to 49 and the same seed, the draws are those of NumPy's global generator in that code.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np

Rule = Literal["decision_transformer", "first", "all"]
RULES = ("decision_transformer", "first", "all")


@dataclass(frozen=True, order=True)
class Piece:
    """Rows [start, stop) of a checkpoint: an episode, or the part of one that the checkpoint holds.

    Attributes:
        ended: the last row is terminal.
        padding: rows at the beginning that no one played.
    """

    checkpoint: int
    start: int
    stop: int
    ended: bool = True
    padding: int = 0

    @property
    def logged(self) -> int:
        """Rows in the log."""
        return self.stop - self.start

    @property
    def actions(self) -> int:
        """Actions in the store. Of a piece without its end the last frame is the final observation."""
        return self.logged - self.padding - (not self.ended)


@dataclass(frozen=True)
class Ends:
    """A checkpoint by its terminal rows.

    Attributes:
        rows: that may be read.
        terminals: (k,) int64, ascending.
        older: rows behind them, which may not.
    """

    rows: int
    terminals: np.ndarray
    older: int = 0


@dataclass
class Selection:
    """What is taken, and what is not.

    Attributes:
        pieces: what is taken.
        without_end: pieces that were left out since they have no end.
        given_up: what lay before a visit that was given up.
        older: rows of an earlier round of the memory, at the ends of checkpoints that were taken to their ends.
    """

    pieces: list[Piece] = field(default_factory=list)
    without_end: list[Piece] = field(default_factory=list)
    given_up: list[Piece] = field(default_factory=list)
    older: int = 0

    @property
    def logged(self) -> int:
        """Rows of the log that are taken."""
        return sum(piece.logged for piece in self.pieces)


def in_order(ends: Callable[[int], Ends], numbers: Sequence[int], *, transitions: int | None, keep: bool) -> Selection:
    """Take episodes one after the other, checkpoint after checkpoint.

    Args:
        ends: number of a checkpoint -> its ends; asked for once each.
        numbers: checkpoints in their order.
        transitions: stop after the episode that reaches so many; None for all.
        keep: take pieces without an end, too.
    """
    selection = Selection()
    taken = 0
    for number in numbers:
        if transitions is not None and taken >= transitions:
            break
        log, start = ends(number), 0
        for terminal in map(int, log.terminals):
            selection.pieces.append(Piece(number, start, terminal + 1))
            taken, start = taken + terminal + 1 - start, terminal + 1
            if transitions is not None and taken >= transitions:
                break
        else:
            selection.older += log.older
            if start < log.rows:
                rest = Piece(number, start, log.rows, ended=False)
                (selection.pieces if keep else selection.without_end).append(rest)
                taken += rest.logged if keep else 0
    return selection


def decision_transformer(
    ends: Callable[[int], Ends],
    numbers: Sequence[int],
    *,
    transitions: int,
    per_visit: int,
    read_up_to: int,
    seed: int,
    keep: bool,
) -> Selection:
    """Draw visits to checkpoints as the module says. Pieces are in the order of drawing.

    Args:
        ends: number of a checkpoint -> its ends; asked for only where a visit goes.
        numbers: checkpoints to draw from.
        transitions: enough of them.
        per_visit: one less than the episodes of a visit.
        read_up_to: row of a checkpoint that no visit may reach.
        seed: of the draws.
        keep: instead of giving a visit up, take its episodes and the piece up to ``read_up_to``.
    """
    random = np.random.RandomState(seed)  # the legacy generator, since the published code draws from it
    reached = dict.fromkeys(numbers, 0)
    finished: set[int] = set()
    selection = Selection()
    taken = 0
    while taken < transitions and len(finished) < len(numbers):
        number = int(random.choice(np.asarray(numbers), 1)[0])
        if number in finished:
            continue
        log, start = ends(number), reached[number]
        stop = min(log.rows, read_up_to)
        within = log.terminals[(log.terminals >= start) & (log.terminals < stop)]
        visit = _episodes(number, start, within[: per_visit + 1])
        after = visit[-1].stop if visit else start
        if len(visit) <= per_visit or after >= read_up_to:
            finished.add(number)
            rest = [Piece(number, after if keep else start, stop, ended=False)]
            if keep:
                visit += rest if after < stop else []
            else:
                visit, selection.given_up = [], selection.given_up + (rest if start < stop else [])
        selection.pieces += visit
        taken += sum(piece.logged for piece in visit)
        reached[number] = after
    return selection


def _episodes(number: int, start: int, terminals: np.ndarray) -> list[Piece]:
    stops = (terminals + 1).tolist()
    return [Piece(number, first, stop) for first, stop in zip([start, *stops], stops, strict=False)]
