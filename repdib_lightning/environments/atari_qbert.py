"""A scripted policy of Qbert."""

from __future__ import annotations

from collections import deque
from typing import ClassVar

import numpy as np

from repdib_lightning.environments.atari_script import Script

Cube = tuple[int, int]
"""Row from the top, and column."""


class QbertScript(Script):
    """Hops the shortest way to a cube that has not changed its colour yet; sees no enemies."""

    game = "qbert"

    _COLUMNS: ClassVar[list[list[int]]] = [
        [77],
        [65, 93],
        [53, 77, 105],
        [41, 67, 93, 117],
        [29, 53, 77, 105, 129],
        [17, 41, 65, 93, 117, 141],
    ]
    """Where the player stands on each cube: across, row by row."""
    _TOP, _ROW, _NEAR = 25, 28, 3
    """Where the player stands on the top cube, how much lower on each row; how near to it he stands still."""
    _HOPS: ClassVar[dict[str, Cube]] = {"RIGHT": (1, 1), "DOWN": (1, 0), "UP": (-1, 0), "LEFT": (-1, -1)}
    _CUBES: ClassVar[list[Cube]] = [(row, column) for row in range(6) for column in range(row + 1)]

    def reset(self) -> None:
        """Forget the game before."""
        super().reset()
        self._unchanged: int | None = None

    def _choose(self, now: dict[str, int], ram: np.ndarray, random: np.random.Generator) -> str:
        colours = self._all("cubes", ram)
        if len(set(colours)) == 1:
            self._unchanged = colours[0]  # a round begins
        here = self._standing(now)
        if here is None:
            return "NOOP"
        left = {cube for cube, colour in zip(self._CUBES, colours, strict=True) if colour == self._unchanged}
        return self._towards(left - {here}, here, list(random.permutation(list(self._HOPS))))

    def _standing(self, now: dict[str, int]) -> Cube | None:
        """The cube that the player stands on; None while he hops or falls."""
        row = round((now["player_y"] - self._TOP) / self._ROW)
        if not 0 <= row < 6 or abs(now["player_y"] - self._TOP - self._ROW * row) > self._NEAR:
            return None
        away = [abs(place - now["player_x"]) for place in self._COLUMNS[row]]
        return (row, int(np.argmin(away))) if min(away) <= self._NEAR else None

    def _towards(self, wanted: set[Cube], here: Cube, hops: list[str]) -> str:
        """The first hop of a shortest way to any of the wanted cubes; earlier ``hops`` are preferred."""
        first: dict[Cube, str] = {here: "NOOP"}
        queue = deque([here])
        while queue:
            cube = queue.popleft()
            if cube in wanted:
                return first[cube]
            for hop in hops:
                down, across = self._HOPS[hop]
                beyond = (cube[0] + down, cube[1] + across)
                if beyond in self._CUBES and beyond not in first:
                    first[beyond] = hop if cube == here else first[cube]
                    queue.append(beyond)
        return "NOOP"
