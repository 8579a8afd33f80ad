"""The confusion matrix as a picture: rows are true classes, columns what was recognised."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from repdib_lightning.evaluation.figures import COLOURS, plain_axes, png

if TYPE_CHECKING:
    from repdib_lightning.evaluation.recognition import RecognitionReport

_CELL, _SMALL_CELL, _LETTER, _TITLE_LETTER = 0.36, 0.28, 0.08, 0.088
"""Inches, of a cell, of one where there are more than 20 classes, and of a letter of a class or of the title."""
_HEAD, _GAP, _BARS, _EDGE = 0.75, 0.15, 1.3, 0.3


def confusion_matrix(reports: Mapping[str, RecognitionReport]) -> bytes:
    """Share of each true class that was told as each class, with counts, one panel a run; beside it F1 of each class.

    The mean of the bars is macro F1; a class that neither occurs nor is predicted has no bar.
    """
    first = next(iter(reports.values()))
    square = len(first.classes) * (_CELL if len(first.classes) <= 20 else _SMALL_CELL)
    names = 0.55 + _LETTER * max(map(len, first.classes))
    titles = {run: f"{run}: macro F1 {report.scores.f1_macro:.2f}" for run, report in reports.items()}
    wide = max(names + square + _GAP + _BARS + _EDGE, _EDGE + _TITLE_LETTER * max(map(len, titles.values())))
    tall = _HEAD + square + names
    figure = Figure(figsize=(wide * len(reports), tall))
    for place, (run, report) in enumerate(reports.items()):
        left, whole = place * wide + names, wide * len(reports)
        matrix = figure.add_axes((left / whole, names / tall, square / whole, square / tall))
        _draw_matrix(matrix, report)
        bars = figure.add_axes(((left + square + _GAP) / whole, names / tall, _BARS / whole, square / tall))
        _draw_bars(bars, report)
        corner = (place * wide + 0.12) / whole
        figure.text(corner, 1 - 0.1 / tall, titles[run], fontsize=11, va="top")
        told = f"{report.clips} clips; off the diagonal: mistaken"
        figure.text(corner, 1 - 0.34 / tall, told, fontsize=9, va="top", color="0.35")
    return png(figure)


def _draw_matrix(axis: Axes, report: RecognitionReport) -> None:
    counts = np.array(report.confusion)
    share = counts / np.maximum(counts.sum(1, keepdims=True), 1)
    axis.imshow(share, cmap="Blues", vmin=0, vmax=1, aspect="auto")
    axis.set_xticks(range(len(counts)), report.classes, fontsize=8, rotation=90)
    axis.set_yticks(range(len(counts)), report.classes, fontsize=8)
    axis.set_xlabel("recognised as", fontsize=9)
    axis.set_ylabel(f"true {report.target}", fontsize=9)
    axis.spines[:].set_color("0.8")
    between = np.arange(1, len(counts)) - 0.5
    axis.set_xticks(between, minor=True)
    axis.set_yticks(between, minor=True)
    axis.grid(which="minor", color="0.93", linewidth=0.6)
    axis.tick_params(which="both", length=0)
    for (row, column), number in np.ndenumerate(counts):
        if number:
            colour = "white" if share[row, column] > 0.55 else "0.25"
            axis.text(column, row, str(number), ha="center", va="center", fontsize=7, color=colour)


def _draw_bars(axis: Axes, report: RecognitionReport) -> None:
    for place, name in enumerate(report.classes):
        f1 = report.f1[name]
        if f1 is not None:
            axis.barh(place, f1, 0.7, color=COLOURS[4])
            axis.text(0.03, place, f"{f1:.2f}", va="center", fontsize=7, color="0.15")
    axis.axvline(report.scores.f1_macro, color=COLOURS[5], linewidth=1.2, linestyle="--")
    axis.set_xlim(0, 1.05)
    axis.set_ylim(len(report.classes) - 0.5, -0.5)
    axis.set_yticks([])
    axis.set_xticks([0, 0.5, 1], ["0", "0.5", "1"], fontsize=8)
    axis.set_xlabel("F1; dashed: mean", fontsize=9)
    plain_axes(axis)
    axis.grid(axis="y", visible=False)
