"""Training curves of a suite: mean over seeds with a band."""

from __future__ import annotations

import csv
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from repdib_lightning.data.files import whole_file
from repdib_lightning.evaluation.curves import read_curves
from repdib_lightning.experiments import statistics
from repdib_lightning.experiments.results import Results
from repdib_lightning.experiments.suite import Grid


@dataclass(frozen=True)
class Band:
    """A logged value of one setting at the steps that all its seeds logged.

    Attributes:
        steps: (n,). mean, low, high: (n,), the mean over seeds and its 95 % interval (the mean itself for one seed).
        seeds: how many.
    """

    steps: np.ndarray
    mean: np.ndarray
    low: np.ndarray
    high: np.ndarray
    seeds: int


def bands(results: Results, grid: Grid) -> dict[str, dict[str, Band]]:
    """Column of metrics.csv -> setting -> band; only the suite's ``curves``, and what was logged."""
    found: dict[str, dict[str, Band]] = {}
    for setting in grid.settings:
        points = [results.point(setting, seed) for seed in results.seeds]
        runs = [read_curves(point.folder / "metrics.csv") for point in points if point is not None]
        for name in results.suite.curves:
            logged = [run[name] for run in runs if name in run]
            if logged:
                found.setdefault(name, {})[setting.name] = _band(logged)
    return found


def _band(logged: list[np.ndarray]) -> Band:
    by_step = [dict(points) for points in logged]
    steps = sorted(set.intersection(*(set(points) for points in by_step)))
    values = np.array([[points[step] for step in steps] for points in by_step])
    estimates = [statistics.mean(values[:, i]) for i in range(len(steps))]
    mean = np.array([estimate.value for estimate in estimates])
    low = np.array([estimate.value if estimate.low is None else estimate.low for estimate in estimates])
    high = np.array([estimate.value if estimate.high is None else estimate.high for estimate in estimates])
    return Band(np.array(steps), mean, low, high, len(logged))


def write_bands(path: Path, grids: dict[str, dict[str, dict[str, Band]]]) -> None:
    """Write grid -> column -> setting -> band as one CSV table."""
    with whole_file(path) as aside, open(aside, "w", newline="") as file:
        table = csv.writer(file)
        table.writerow(["grid", "setting", "column", "step", "seeds", "mean", "low", "high"])
        for grid, columns in grids.items():
            for column, settings in columns.items():
                for setting, band in settings.items():
                    for step, *values in zip(band.steps, band.mean, band.low, band.high, strict=True):
                        shown = [f"{value:.6g}" for value in values]
                        table.writerow([grid, setting, column, int(step), band.seeds, *shown])
