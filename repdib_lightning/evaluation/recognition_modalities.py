"""What a classifier needs: bars of macro F1 with each modality missing and with each alone, and attention weights."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from repdib_lightning.evaluation.figures import COLOURS, plain_axes, png

if TYPE_CHECKING:
    from repdib_lightning.evaluation.recognition import RecognitionReport

WITHOUT, ALONE, WEIGHT = COLOURS[0], COLOURS[4], COLOURS[1]
_PAPER = {"facecolor": "white", "edgecolor": "none", "alpha": 0.8, "pad": 0.8}
"""Behind numbers, so that lines do not cross them out."""


def modality_bars(reports: Mapping[str, RecognitionReport]) -> bytes | None:
    """One line of panels a run, scores left, weights right; None if no run has several modalities."""
    shown = {run: report for run, report in reports.items() if report.without}
    if not shown:
        return None
    most = max(len(report.without) for report in shown.values())
    weighed = any(report.attention for report in shown.values())
    widths = [1.35 * most + 0.8, 0.7 * most + 0.8][: 1 + weighed]
    figure = Figure(figsize=(max(7.5, sum(widths) + 0.6), 2.9 * len(shown) + 0.5), layout="constrained")
    panels = figure.subplots(len(shown), len(widths), squeeze=False, width_ratios=widths)
    for line, (run, report) in zip(panels, shown.items(), strict=True):
        _draw_scores(line[0], report)
        title = f"{run}: a bar far below the line is missed, a high pale one tells much by itself"
        line[0].set_title(title, loc="left", fontsize=10)
        if weighed:
            _draw_weights(line[1], report)
    handles, labels = panels[0, 0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=len(labels), frameon=False, fontsize=9)
    return png(figure)


def _draw_scores(axis: Axes, report: RecognitionReport) -> None:
    places = np.arange(len(report.without))
    without = [scores.f1_macro for scores in report.without.values()]
    alone = [report.only[name] for name in report.without]
    for shift, heights, colour, label in ((-0.2, without, WITHOUT, "without it"), (0.2, alone, ALONE, "it alone")):
        axis.bar(places + shift, heights, 0.37, color=colour, label=label)
        for x, height in zip(places + shift, heights, strict=True):
            axis.text(x, height + 0.02, f"{height:.2f}", ha="center", va="bottom", fontsize=8, bbox=_PAPER)
    axis.axhline(report.scores.f1_macro, color=COLOURS[5], linewidth=1.4, label="with all modalities")
    axis.axhline(report.chance, color="black", linewidth=1, linestyle=":", label="most frequent class each time")
    axis.set_xticks(places, list(report.without), fontsize=9)
    axis.set_ylim(0, 1.1)
    axis.set_ylabel("macro F1")
    plain_axes(axis)


def _draw_weights(axis: Axes, report: RecognitionReport) -> None:
    axis.set_title("mean attention weight", loc="left", fontsize=10)
    if not report.attention:
        axis.set_visible(False)
        return
    places, heights = range(len(report.attention)), list(report.attention.values())
    axis.bar(places, heights, 0.6, color=WEIGHT)
    for place, height in zip(places, heights, strict=True):
        above = 0.02 * max(heights)
        axis.text(place, height + above, f"{height:.2f}", ha="center", va="bottom", fontsize=8, bbox=_PAPER)
    axis.axhline(1 / len(places), color="black", linewidth=1, linestyle=":")
    axis.set_xticks(places, list(report.attention), fontsize=9, rotation=30, ha="right")
    axis.set_ylim(0, max(*heights, 1 / len(places)) * 1.15)
    plain_axes(axis)
