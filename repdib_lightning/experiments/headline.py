"""The paper's table beside ours, its "error" in both readings; and claims held against the numbers."""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np

from repdib_lightning.errors import UserError, nearest
from repdib_lightning.experiments import statistics
from repdib_lightning.experiments.results import Results
from repdib_lightning.experiments.statistics import Estimate
from repdib_lightning.experiments.suite import Claim, Grid, HeadlineRow
from repdib_lightning.experiments.suite_measures import is_whole

READINGS = {"error": "error of predicting it", "kept": "how much of it is kept"}
"""Last part of a measure -> what a relative "error" can mean."""

WHOLE = ""
"""The reading of a whole measure, which is shown as it is."""

FEWEST_SEEDS = 5
"""Below, a bootstrap interval is little more than the range of the seeds, and no claim is judged by it."""

TIE = 0.01
"""Values of the paper that differ by less than this are taken as equal when orders are compared."""


@dataclass(frozen=True)
class HeadlineCell:
    """A setting in one reading: relative to the baseline (None where that is zero, or the measure whole), and as is."""

    relative: Estimate | None
    absolute: Estimate


@dataclass(frozen=True)
class HeadlineLine:
    """One row of the paper's table in one reading.

    Attributes:
        row: of the suite. reading: a key of READINGS, or WHOLE. cells: setting -> numbers.
        agrees: whether every pair of settings that the paper tells apart has the same order here; None where the paper
            tells none apart, or there is nothing here to compare.
    """

    row: HeadlineRow
    reading: str
    cells: dict[str, HeadlineCell]
    agrees: bool | None


def headline(results: Results) -> list[HeadlineLine]:
    """All rows: relative ones in both readings, on the first grid; whole measures on their own."""
    lines = []
    for row in results.suite.headline:
        grid = results.suite.grid(row.grid)
        if is_whole(row.measure):
            lines.append(_whole_line(results, grid, row))
        else:
            lines += [_line(results, grid, row, reading) for reading in READINGS]
    return lines


def _whole_line(results: Results, grid: Grid, row: HeadlineRow) -> HeadlineLine:
    _check_measure(results, grid, row.measure, f"headline.{row.label}")
    found = {setting.name: list(results.values(setting, row.measure).values()) for setting in grid.settings}
    cells = {name: HeadlineCell(None, statistics.mean(np.array(values))) for name, values in found.items() if values}
    return HeadlineLine(row, WHOLE, cells, _agrees(row, {name: cell.absolute for name, cell in cells.items()}))


def _line(results: Results, grid: Grid, row: HeadlineRow, reading: str) -> HeadlineLine:
    measure = f"{row.measure}/{reading}"
    _check_measure(results, grid, measure, f"headline.{row.label}")
    baseline = next(setting for setting in grid.settings if setting.name == grid.baseline)
    cells = {}
    for setting in grid.settings:
        ours, theirs = results.paired(setting, baseline, measure)
        if len(ours):
            cells[setting.name] = HeadlineCell(statistics.paired_ratio(ours, theirs), statistics.mean(ours))
    relative = {name: cell.relative for name, cell in cells.items() if cell.relative is not None}
    return HeadlineLine(row, reading, cells, _agrees(row, relative))


def _agrees(row: HeadlineRow, ours: dict[str, Estimate]) -> bool | None:
    told = []
    for first, second in itertools.combinations([name for name in row.paper if name in ours], 2):
        gap = row.paper[first] - row.paper[second]
        if abs(gap) >= TIE:
            told.append((ours[first].value - ours[second].value) * gap > 0)
    return all(told) if told else None


@dataclass(frozen=True)
class Verdict:
    """A claim, the number that it is about, whether it holds (None: it cannot be told), and by how many seeds."""

    claim: Claim
    estimate: Estimate | None
    holds: bool | None
    seeds: int


def verdicts(results: Results) -> list[Verdict]:
    """Every claim of the suite, on its grid."""
    return [_verdict(results, results.suite.grid(claim.grid), claim) for claim in results.suite.claims]


def _verdict(results: Results, grid: Grid, claim: Claim) -> Verdict:
    _check_measure(results, grid, claim.measure, f"claims.{claim.text}")
    by_name = {setting.name: setting for setting in grid.settings}
    ours, theirs = results.paired(by_name[claim.setting], by_name[claim.than or grid.baseline], claim.measure)
    if not len(ours):
        return Verdict(claim, None, None, 0)
    estimate = _estimate(claim, ours, theirs)
    if estimate is None:
        return Verdict(claim, None, None, len(ours))
    if claim.judge == "interval" and len(ours) < FEWEST_SEEDS:
        return Verdict(claim, estimate, None, len(ours))
    return Verdict(claim, estimate, _holds(claim, estimate), len(ours))


def _holds(claim: Claim, estimate: Estimate) -> bool | None:
    if claim.judge == "mean":
        return _keeps(claim, estimate.value, estimate.value)
    if estimate.low is None or estimate.high is None:
        return None
    whole, some = _keeps(claim, estimate.low, estimate.high), _keeps(claim, estimate.high, estimate.low)
    if claim.judge == "interval":
        return None if some and not whole else whole
    return whole if claim.judge == "whole" else some


def _keeps(claim: Claim, lowest: float, highest: float) -> bool:
    below = claim.at_most is None or highest <= claim.at_most
    return below and (claim.at_least is None or lowest >= claim.at_least)


def _estimate(claim: Claim, ours: np.ndarray, theirs: np.ndarray) -> Estimate | None:
    if claim.of == "difference":
        return statistics.paired_difference(ours, theirs)
    return statistics.paired_ratio(ours, theirs) if claim.of == "ratio" else statistics.mean(ours)


def _check_measure(results: Results, grid: Grid, measure: str, key: str) -> None:
    known = results.measures(grid)
    if measure not in known:
        raise UserError(f"{results.suite.file}: {key}: no point has the measure '{measure}', {nearest(measure, known)}")
