"""What a grid shows: every setting's numbers over seeds, and their differences from the baseline."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from repdib_lightning.experiments import statistics
from repdib_lightning.experiments.results import Results
from repdib_lightning.experiments.snapshots import MONOTONE
from repdib_lightning.experiments.statistics import Estimate
from repdib_lightning.experiments.suite import Grid
from repdib_lightning.rl import AGENTS

Direction = Literal["up", "down", ""]

_REACHED = (
    *("return", "success", "solved", "coverage", "entropy", "topology", "topology_pairs"),
    *("mean_return", "first_return", "best_return", "mean_success", "final_success", "mean_coverage", MONOTONE),
)
_NEEDED = ("steps_to_solve", "moves")
_NEITHER_OF_RECOGNITION = ("weight", "perplexity")
_NEITHER_OF_GROUPS = ("share", "drawn", "moved", "moved_unswapped", "psnr_lost_most", "psnr_lost_least")


@dataclass(frozen=True)
class Summary:
    """One measure of one setting over ``n`` seeds."""

    grid: str
    setting: str
    measure: str
    n: int
    mean: Estimate
    iqm: Estimate


@dataclass(frozen=True)
class Difference:
    """One measure of one setting, held against the baseline over the ``n`` seeds that both have.

    Attributes:
        difference: setting - baseline, seeds in pairs. ratio: of the means; None where the baseline is zero.
        better: probability that a run is better than one of the baseline; None where neither direction is better.
    """

    grid: str
    setting: str
    baseline: str
    measure: str
    n: int
    difference: Estimate
    ratio: Estimate | None
    better: Estimate | None


def direction(measure: str, factors: dict[str, str]) -> Direction:
    """Whether more of a measure is better (``up``), less is (``down``), or neither.

    State and agent should be kept, noise and background dropped; an error is what was not kept. Of fine-tuning
    (``AGENT/NAME/...``), what was reached should be high, what it took should be low; an exploration should reach much,
    without a reward. Groups should hold, draw and move
    different factors; how much one of them holds or draws alone says nothing of that.
    """
    if measure.startswith("codes/"):
        return ""
    if measure.startswith("groups/"):
        return "" if measure.rpartition("/")[2] in _NEITHER_OF_GROUPS else "up"
    if measure.startswith("recognition/"):
        return "" if measure.split("/")[1] in _NEITHER_OF_RECOGNITION else "up"
    if measure.startswith("explore/"):
        return "up" if measure.startswith("explore/coverage") else ""
    if measure.startswith("val/"):
        reached = measure.endswith("accuracy") or measure.startswith("val/f1")
        return "up" if reached else "down" if measure == "val/loss" or "/raw/" in measure else ""
    first, target, quantity = measure.split("/", 2)
    if first in AGENTS:
        return "up" if quantity in _REACHED else "down" if quantity in _NEEDED else ""
    kind = {**factors, "state": "state", "noise": "noise", "agent": "state", "background": "noise"}.get(target)
    if kind is None or quantity not in ("kept", "error", "rmse"):
        return ""
    return "up" if (kind == "state") == (quantity == "kept") else "down"


def summaries(results: Results, grid: Grid) -> list[Summary]:
    """Every measure of every setting of a grid."""
    found = []
    for measure in results.measures(grid):
        for setting in grid.settings:
            values = np.array(list(results.values(setting, measure).values()))
            if len(values):
                estimates = statistics.mean(values), statistics.iqm(values)
                found.append(Summary(grid.name, setting.name, measure, len(values), *estimates))
    return found


def differences(results: Results, grid: Grid) -> list[Difference]:
    """Every measure of every setting but the baseline, where both have it."""
    baseline = next(setting for setting in grid.settings if setting.name == grid.baseline)
    found = []
    for measure in results.measures(grid):
        for setting in grid.settings:
            ours, theirs = results.paired(setting, baseline, measure)
            if setting is baseline or not len(ours):
                continue
            better = direction(measure, results.factors)
            sign = -1.0 if better == "down" else 1.0
            found.append(
                Difference(
                    grid.name,
                    setting.name,
                    baseline.name,
                    measure,
                    len(ours),
                    statistics.paired_difference(ours, theirs),
                    statistics.paired_ratio(ours, theirs),
                    statistics.probability_of_improvement(sign * ours, sign * theirs) if better else None,
                )
            )
    return found
