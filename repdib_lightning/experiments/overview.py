"""A few measures over all grids of a suite at once: the figure that opens a report."""

from __future__ import annotations

from matplotlib.figure import Figure

from repdib_lightning.errors import UserError, nearest
from repdib_lightning.evaluation.figures import COLOURS, plain_axes, png, slant_names
from repdib_lightning.experiments.comparison import direction
from repdib_lightning.experiments.figures import HINTS, draw_seeds
from repdib_lightning.experiments.page import Part
from repdib_lightning.experiments.results import Results
from repdib_lightning.experiments.suite import Grid

_WIDTH_OF_A_SETTING, _MARGIN, _HEIGHT = 0.55, 0.9, 3.2


def overview_parts(results: Results) -> list[Part]:
    """One part with a figure a measure that the suite names; none without.

    Raises:
        UserError: a measure that no point has, once all are finished.
    """
    suite = results.suite
    anywhere = dict.fromkeys(name for grid in suite.grids for name in results.measures(grid))
    for measure in suite.overview:
        if measure not in anywhere and not results.missing:
            raise UserError(f"{suite.file}: overview: no point has '{measure}', {nearest(measure, anywhere)}")
    drawn = {f"overview-{m.replace('/', '-')}": overview_figure(results, m) for m in suite.overview if m in anywhere}
    sentence = "Every grid with the same axis: each dot is a seed, the bar the mean with its 95 % interval."
    return [Part("Overview", [sentence], [], drawn)] if drawn else []


def overview_figure(results: Results, measure: str) -> bytes:
    """One panel a grid that has the measure, as wide as it has settings, all with the same axis."""
    grids = [grid for grid in results.suite.grids if measure in results.measures(grid)]
    widths = [_WIDTH_OF_A_SETTING * len(grid.settings) + _MARGIN for grid in grids]
    figure = Figure(figsize=(sum(widths), _HEIGHT), layout="constrained")
    panels = figure.subplots(1, len(grids), sharey=True, width_ratios=widths, squeeze=False)[0]
    colours = _colours(grids)
    for panel, grid in zip(panels, grids, strict=True):
        for place, setting in enumerate(grid.settings):
            values = list(results.values(setting, measure).values())
            if values:
                draw_seeds(panel, place, values, colours[setting.name])
        panel.set_title(grid.name, fontsize=10)
        panel.set_xticks(range(len(grid.settings)), [setting.name for setting in grid.settings], fontsize=8)
        slant_names(panel)
        panel.set_xlim(-0.6, len(grid.settings) - 0.4)
        plain_axes(panel)
    figure.suptitle(measure + HINTS[direction(measure, results.factors)], fontsize=11)
    return png(figure)


def _colours(grids: list[Grid]) -> dict[str, str]:
    """The same colour for a setting's name in all panels."""
    names = dict.fromkeys(setting.name for grid in grids for setting in grid.settings)
    return {name: COLOURS[place % len(COLOURS)] for place, name in enumerate(names)}
