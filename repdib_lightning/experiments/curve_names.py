"""Checks that the columns which a suite's report is to draw were logged."""

from __future__ import annotations

import csv
from collections.abc import Iterable
from pathlib import Path

from repdib_lightning.errors import UserError, nearest
from repdib_lightning.experiments.results import Results
from repdib_lightning.experiments.suite import Suite


def check_curves(results: Results) -> None:
    """Check ``curves`` and ``finetune_curves``.

    Only where every point is finished, since a column may be one that a missing point logs; and only what the file
    names itself, since without a goal nothing is evaluated that the default could draw.

    Raises:
        UserError: a column that no run has, with the nearest one.
    """
    if results.missing:
        return
    suite, points = results.suite, results.points.values()
    trained = [point.folder / "metrics.csv" for point in points if point.setting.pretrained]
    tuned = [point.finetune_folder(name) / "progress.csv" for point in points for name in point.finetune]
    checked = (
        ("curves", suite.curves, Suite.curves, trained),
        ("finetune_curves", suite.finetune_curves, Suite.finetune_curves, tuned),
    )
    for key, names, default, files in checked:
        if names == default:
            continue
        columns = _columns(files)
        for name in names:
            if name not in columns:
                hint = nearest(name, columns) or "there is none"
                raise UserError(f"{suite.file}: {key}: no run has logged '{name}', {hint}")


def _columns(files: Iterable[Path]) -> set[str]:
    """Names of all columns but those that count."""
    found: set[str] = set()
    for path in files:
        try:
            with open(path, newline="") as file:
                found |= set(next(csv.reader(file), []))
        except OSError as error:
            raise UserError(f"{path}: cannot be read ({error.strerror or error})") from error
    return found - {"epoch", "step"}
