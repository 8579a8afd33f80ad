"""Curves of training and of fine-tuning: mean over seeds with a band."""

from __future__ import annotations

import csv
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from repdib_lightning.data.files import whole_file
from repdib_lightning.errors import UserError
from repdib_lightning.evaluation.curves import read_curves
from repdib_lightning.experiments import statistics
from repdib_lightning.experiments.results import Results
from repdib_lightning.experiments.suite import Grid

_NUMBERS = ("step", "seeds", "mean", "low", "high")


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
        points = [results.point(setting, seed) for seed in results.seeds if setting.pretrained]
        runs = [read_curves(point.folder / "metrics.csv") for point in points if point is not None]
        for name in results.suite.curves:
            logged = [run[name] for run in runs if name in run]
            if logged:
                found.setdefault(name, {})[setting.name] = _band(logged)
    return found


def finetune_bands(results: Results, grid: Grid) -> dict[str, dict[str, Band]]:
    """``AGENT/NAME/COLUMN`` of the fine-tunings' progress.csv -> setting -> band.

    Only the suite's ``finetune_curves``, and what was logged: without a goal there is nothing to evaluate.
    """
    found: dict[str, dict[str, Band]] = {}
    for setting in grid.settings:
        points = [point for seed in results.seeds if (point := results.point(setting, seed)) is not None]
        for name in setting.finetune.runs if setting.finetune is not None else ():
            runs = [read_curves(point.finetune_folder(name) / "progress.csv") for point in points]
            for column in results.suite.finetune_curves:
                logged = [run[column] for run in runs if column in run]
                if setting.finetune is not None and logged:
                    found.setdefault(f"{setting.finetune.agent}/{name}/{column}", {})[setting.name] = _band(logged)
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


def read_bands(path: Path) -> dict[str, dict[str, dict[str, Band]]]:
    """Grid -> column -> setting -> band, as :func:`write_bands` wrote them.

    Raises:
        UserError: no such file, or it is another one.
    """
    rows: dict[tuple[str, str, str], list[list[float]]] = {}
    try:
        with open(path, newline="") as file:
            for line in csv.DictReader(file):
                place = line["grid"], line["column"], line["setting"]
                rows.setdefault(place, []).append([float(line[name]) for name in _NUMBERS])
    except (OSError, KeyError, TypeError, ValueError) as error:
        raise UserError(f"{path}: not the curves of a report ({type(error).__name__}: {error})") from error
    found: dict[str, dict[str, dict[str, Band]]] = {}
    for (grid, column, setting), numbers in rows.items():
        steps, seeds, mean, low, high = np.array(numbers).T
        found.setdefault(grid, {}).setdefault(column, {})[setting] = Band(steps, mean, low, high, int(seeds[0]))
    return found


def write_bands(path: Path, grids: dict[str, dict[str, dict[str, Band]]]) -> None:
    """Write grid -> column -> setting -> band as one CSV table."""
    with whole_file(path) as aside, open(aside, "w", newline="") as file:
        table = csv.writer(file)
        table.writerow(["grid", "setting", "column", *_NUMBERS])
        for grid, columns in grids.items():
            for column, settings in columns.items():
                for setting, band in settings.items():
                    for step, *values in zip(band.steps, band.mean, band.low, band.high, strict=True):
                        shown = [f"{value:.6g}" for value in values]
                        table.writerow([grid, setting, column, int(step), band.seeds, *shown])
