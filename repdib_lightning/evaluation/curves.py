"""Training curves from the CSV file that a run logs."""

from __future__ import annotations

import csv
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from repdib_lightning.errors import UserError
from repdib_lightning.evaluation.figures import COLOURS, panel_grid, plain_axes, png

WORTH_SHOWING = ("loss", "accuracy", "perplexity")
MOST_PANELS = 6


def read_curves(path: Path) -> dict[str, np.ndarray]:
    """Columns of a metrics.csv with a ``step`` column: name -> (n, 2) of (step, value), empty cells left out.

    Raises:
        UserError: no such file, no ``step`` column, or a cell that is no number.
    """
    try:
        with open(path, newline="") as file:
            lines = list(csv.DictReader(file))
    except (UnicodeDecodeError, csv.Error) as error:
        raise UserError(f"{path}: not a readable CSV file ({error})") from error
    except OSError as error:
        raise UserError(f"{path}: cannot be read ({error.strerror or error})") from error
    if lines and "step" not in lines[0]:
        raise UserError(f"{path}: has no column 'step' (columns: {', '.join(map(str, lines[0]))})")
    curves: dict[str, list[tuple[float, float]]] = {}
    for line in lines:
        for name, cell in line.items():
            if name not in ("step", "epoch") and cell and line["step"]:
                curves.setdefault(name, []).append((_number(path, line["step"]), _number(path, cell)))
    return {name: np.array(points) for name, points in curves.items()}


def _number(path: Path, cell: str | list[str]) -> float:
    try:
        return float(cell)  # type: ignore[arg-type]
    except (ValueError, TypeError) as error:
        raise UserError(f"{path}: {cell!r:.60} is no number") from error


def training_curves(files: Mapping[str, Path]) -> bytes | None:
    """Losses, accuracies and perplexities against the step, the runs in one panel each; None if nothing was logged.

    Shown are the names that most runs share, at most six.
    """
    runs = {run: read_curves(path) for run, path in files.items()}
    names = {name for curves in runs.values() for name in curves if any(word in name for word in WORTH_SHOWING)}
    if not names:
        return None
    ranked = sorted(names, key=lambda name: (-sum(name in curves for curves in runs.values()), len(name), name))
    shown = ranked[:MOST_PANELS]
    figure, panels = panel_grid(len(shown), 3, 3.6, 2.5)
    for panel, name in zip(panels, shown, strict=True):
        for i, (run, curves) in enumerate(runs.items()):
            points = curves.get(name, np.empty((0, 2)))
            panel.plot(*points.T, color=COLOURS[i % len(COLOURS)], label=run, linewidth=1.3)
        panel.set_title(name, fontsize=10)
        panel.set_xlabel("step", fontsize=9)
        plain_axes(panel)
    handles, labels = panels[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=len(labels), frameon=False)
    return png(figure)
