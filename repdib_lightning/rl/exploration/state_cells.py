"""How much of its state space an agent has been in, where no map of it exists."""

from __future__ import annotations

import numpy as np

BITS = 14


class StateCells:
    """Counts which cells of a state space were visited: cells of random half-spaces (Charikar 2002; as in Tang et al.
    2017, "#Exploration"), always the same ones for states of the same width.

    A state x of any scale becomes tanh(x), then the signs of ``BITS`` fixed random affine functions of it: 16,384
    cells, many of which no body can be in, so that numbers compare runs and mean nothing by themselves.

    Args:
        width: X, of the state.
    """

    def __init__(self, width: int) -> None:
        random = np.random.default_rng(width)
        self._directions = random.standard_normal((width, BITS))
        self._offsets = 0.5 * random.standard_normal(BITS)
        self._visited = np.zeros(2**BITS, bool)

    def visit(self, states: np.ndarray) -> None:
        """Add states (n, X)."""
        bits = np.tanh(states) @ self._directions + self._offsets > 0
        self._visited[bits @ (1 << np.arange(BITS))] = True

    @property
    def visited(self) -> int:
        """Cells that were visited at least once."""
        return int(self._visited.sum())
