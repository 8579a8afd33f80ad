"""Cells of a state space: counted once each, the same in every run."""

from __future__ import annotations

import numpy as np
import pytest

from repdib_lightning.rl.exploration.state_cells import BITS, StateCells


def states(count, width=24, seed=0, scale=1.0):
    return scale * np.random.default_rng(seed).normal(size=(count, width))


def visited(*parts):
    cells = StateCells(parts[0].shape[1])
    for part in parts:
        cells.visit(part)
    return cells.visited


def slow_cells(rows, cells):
    """Signs of each half-space, state by state."""
    found = set()
    for row in rows:
        inside = [
            sum(np.tanh(x) * d for x, d in zip(row, directions, strict=True)) + offset > 0
            for directions, offset in zip(cells._directions.T, cells._offsets, strict=True)
        ]
        found.add(tuple(bool(side) for side in inside))
    return found


def test_they_are_those_of_a_slow_loop():
    cells, rows = StateCells(5), states(300, 5)
    cells.visit(rows)
    assert cells.visited == len(slow_cells(rows, cells)) > 50


def test_a_cell_counts_once_in_any_order_and_any_parts():
    rows = states(400)
    once = visited(rows)
    assert 0 < once <= 400
    assert once == visited(rows[::-1], rows) == visited(*np.split(rows, 8)) == visited(np.repeat(rows, 3, axis=0))
    assert visited(rows, states(400, seed=1)) > once


@pytest.mark.parametrize("width", [1, 6, 24, 300])
def test_what_stands_still_is_in_one_cell_and_what_moves_farther_is_in_more(width):
    still = np.repeat(states(1, width), 200, axis=0)
    counts = [visited(still + states(200, width, 2, scale)) for scale in (0.0, 1e-9, 0.1, 1.0)]
    assert counts[0] == counts[1] == 1 and counts[1] <= counts[2] < counts[3] <= min(200, 2**BITS)


def test_no_number_is_too_large_and_no_episode_too_short():
    assert visited(states(50, scale=1e30)) > 10
    assert visited(np.array([[np.inf, -np.inf, 0.0]])) == 1
    assert visited(states(0)) == 0
    assert visited(states(3).astype(np.float32)) == visited(states(3))


def test_runs_are_compared_by_the_same_cells():
    one, other = StateCells(7), StateCells(7)
    rows = states(100, 7)
    one.visit(rows)
    other.visit(rows)
    assert np.array_equal(one._visited, other._visited)
