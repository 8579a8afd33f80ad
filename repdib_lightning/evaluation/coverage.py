"""How much of a maze an agent has been in, and how evenly (paper, section on maze navigation, figure on coverage)."""

from __future__ import annotations

import numpy as np


def covered(visits: np.ndarray) -> float:
    """Share of the cells that were visited at least once, 0 to 1.

    Args:
        visits: (cells,) counts.
    """
    return float((visits > 0).mean())


def visitation_entropy(visits: np.ndarray) -> float:
    """Entropy of the visits' distribution over the cells, relative to even visits: 0 for one cell, 1 for all evenly.

    Args:
        visits: (cells,) counts, at least one of them above 0, of at least two cells.
    """
    shares = visits[visits > 0] / visits.sum()
    return max(0.0, float(-(shares * np.log(shares)).sum() / np.log(len(visits))))
