"""Measures against a number that the settings of a grid vary, such as how many groups there are."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from repdib_lightning.evaluation.figures import COLOURS, panel_grid, plain_axes, png
from repdib_lightning.experiments import statistics
from repdib_lightning.experiments.comparison import direction
from repdib_lightning.experiments.figures import HINTS, legend_below
from repdib_lightning.experiments.page import Part
from repdib_lightning.experiments.results import Results
from repdib_lightning.experiments.suite import Against, Setting

_ACROSS = 3
_LINES = ("--", ":", "-.")
_AGAINST, _WITHOUT = COLOURS[0], "#555555"


def against_parts(results: Results) -> list[Part]:
    """One part with a figure for each entry of the suite's ``against`` of which something is finished."""
    made = {entry.name: against_figure(results, entry) for entry in results.suite.against}
    drawn = {f"against-{name}": content for name, content in made.items() if content is not None}
    sentence = (
        "Measures against a number that the settings vary: dots are seeds, the line is their mean with its 95 % "
        "interval; a horizontal line is a setting that has no such number."
    )
    return [Part("Against one number", [sentence], [], drawn)] if drawn else []


def against_figure(results: Results, entry: Against) -> bytes | None:
    """A panel a measure; None where no point with the number is finished."""
    grid = results.suite.grid(entry.grid)
    numbers = grid.numbers(entry.option)
    varied = sorted((s for s in grid.settings if s.name in numbers), key=lambda setting: numbers[setting.name])
    fixed = [setting for setting in grid.settings if setting.name not in numbers]
    known = [m for m in entry.measures if any(results.values(setting, m) for setting in varied)]
    if not known:
        return None
    figure, panels = panel_grid(len(known), min(_ACROSS, len(known)), 4.0, 3.1)
    for panel, measure in zip(panels, known, strict=True):
        _draw_varied(panel, [_values(results, setting, measure) for setting in varied])
        for place, setting in enumerate(fixed):
            _draw_fixed(panel, _values(results, setting, measure), setting.name, _LINES[place % len(_LINES)])
        panel.set_xticks(range(len(varied)), [f"{numbers[setting.name]:g}" for setting in varied])
        panel.set_xlim(-0.4, len(varied) - 0.6)
        panel.set_xlabel(entry.option.rpartition(".")[2], fontsize=9)
        panel.set_title(measure + HINTS[direction(measure, results.factors)], fontsize=9)
        plain_axes(panel)
    legend_below(figure, panels)
    assert isinstance(figure, Figure)
    return png(figure)


def _values(results: Results, setting: Setting, measure: str) -> np.ndarray:
    return np.array(list(results.values(setting, measure).values()))


def _draw_varied(panel: Axes, values: list[np.ndarray]) -> None:
    there = [(place, found) for place, found in enumerate(values) if len(found)]
    for place, found in there:
        panel.plot(np.full(len(found), place), found, "o", color=_AGAINST, markersize=4, alpha=0.6)
    estimates = [(place, statistics.mean(found)) for place, found in there]
    panel.plot([p for p, _ in estimates], [e.value for _, e in estimates], color=_AGAINST, linewidth=1.6, label="mean")
    banded = [(p, e.low, e.high) for p, e in estimates if e.low is not None and e.high is not None]
    if banded:
        places, low, high = zip(*banded, strict=True)
        panel.fill_between(places, low, high, color=_AGAINST, alpha=0.2, linewidth=0)


def _draw_fixed(panel: Axes, values: np.ndarray, name: str, line: str) -> None:
    if not len(values):
        return
    estimate = statistics.mean(values)
    panel.axhline(estimate.value, color=_WITHOUT, linestyle=line, linewidth=1.4, label=f"{name} (n={len(values)})")
    if estimate.low is not None and estimate.high is not None:
        panel.axhspan(estimate.low, estimate.high, color=_WITHOUT, alpha=0.12, linewidth=0)
