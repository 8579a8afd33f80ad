"""Who plays the next game, so that everybody plays his share of the samples although no game's length is known."""

from __future__ import annotations

import sys
from collections.abc import Iterator, Sequence
from typing import overload

_GUESSED = 1000.0
"""Length of a game before any is known."""


class Casting(Sequence[int]):
    """The games that are played, numbered ``players * turn + player``: a list that grows as it is read.

    Which games are kept, and in which order, follows from their lengths alone: the next one is of the player that has
    played least for his share. Which are played may differ, and some are played in vain: while games are under way,
    only the mean of the lengths before can be counted on.

    Args:
        rates: share of the samples of each player, above 0; the sum is 1.
        samples: how many are wanted; the last game goes on to its end.

    Attributes:
        kept: numbers of the games of the recording, in order.
        total: their samples.
    """

    def __init__(self, rates: Sequence[float], samples: int) -> None:
        self._rates, self._samples = rates, samples
        self._given: list[int] = []
        self._turns = [0] * len(rates)
        self._lengths: dict[int, int] = {}
        self._known = [0] * len(rates)
        self._finished = [0] * len(rates)
        self.kept: list[int] = []
        self._kept_turns = [0] * len(rates)
        self._kept_samples = [0] * len(rates)

    @property
    def total(self) -> int:
        """Samples of the games that are kept."""
        return sum(self._kept_samples)

    @property
    def complete(self) -> bool:
        """Whether there are as many as wanted."""
        return self.total >= self._samples

    def played(self, number: int, length: int) -> None:
        """Tell how long a game was."""
        who = number % len(self._rates)
        self._lengths[number] = length
        self._known[who] += length
        self._finished[who] += 1
        while not self.complete:
            who = _least(self._rates, self._kept_samples)
            number = self._kept_turns[who] * len(self._rates) + who
            if number not in self._lengths:
                return
            self.kept.append(number)
            self._kept_turns[who] += 1
            self._kept_samples[who] += self._lengths[number]

    @overload
    def __getitem__(self, place: int) -> int: ...

    @overload
    def __getitem__(self, place: slice) -> Sequence[int]: ...

    def __getitem__(self, place: int | slice) -> int | Sequence[int]:
        """Number of a game; those before it are decided first, and no decision changes."""
        assert isinstance(place, int)
        while len(self._given) <= place:
            who = _least(self._rates, [self._expected(player) for player in range(len(self._rates))])
            self._given.append(self._turns[who] * len(self._rates) + who)
            self._turns[who] += 1
        return self._given[place]

    def _expected(self, who: int) -> float:
        """Samples of a player when what is under way is finished."""
        if self._finished[who]:
            return self._known[who] / self._finished[who] * self._turns[who]
        finished = sum(self._finished)
        return self._turns[who] * (sum(self._known) / finished if finished else _GUESSED)

    def __len__(self) -> int:
        return sys.maxsize

    def __iter__(self) -> Iterator[int]:
        place = 0
        while True:
            yield self[place]
            place += 1


def _least(rates: Sequence[float], played: Sequence[float]) -> int:
    """The player who lacks most of his share; of equals the one of the highest rate, then the first."""
    total = sum(played)
    lacking = [(rate * total - done, rate) for rate, done in zip(rates, played, strict=True)]
    return max(range(len(rates)), key=lambda who: (*lacking[who], -who))
