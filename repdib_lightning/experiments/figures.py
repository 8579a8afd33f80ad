"""Figures of a suite as PNG bytes; each title says what to look for."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from repdib_lightning.evaluation.embedding import tsne
from repdib_lightning.evaluation.figures import COLOURS, number_classes, panel_grid, plain_axes, png, slant_names
from repdib_lightning.evaluation.samples import ProbeSamples
from repdib_lightning.experiments import statistics
from repdib_lightning.experiments.comparison import direction
from repdib_lightning.experiments.curves import Band
from repdib_lightning.experiments.results import Results
from repdib_lightning.experiments.suite import Grid

COLUMNS = 4
CROWDED = 4
"""Names under a panel are turned where there are more of them than this."""

WIDEST_TITLE = 40
"""Characters above a panel; a longer title takes two lines."""

_LINES = ("-", "--", ":")
HINTS = {"up": " (high is good)", "down": " (low is good)", "": ""}


def seed_points(results: Results, grid: Grid, measures: Sequence[str]) -> bytes | None:
    """One panel a measure: every seed a dot, the mean a bar across them with its 95 % interval; None for none."""
    if not measures:
        return None
    crowded = len(grid.settings) > CROWDED
    figure, panels = panel_grid(len(measures), COLUMNS, 3.1, 3.0 if crowded else 2.5)
    for panel, measure in zip(panels, measures, strict=True):
        for place, setting in enumerate(grid.settings):
            values = np.array(list(results.values(setting, measure).values()))
            if len(values):
                draw_seeds(panel, place, values, COLOURS[place % len(COLOURS)])
        hint = HINTS[direction(measure, results.factors)]
        panel.set_title(measure + (f"\n{hint.strip()}" if len(measure + hint) > WIDEST_TITLE else hint), fontsize=9)
        panel.set_xticks(range(len(grid.settings)), [setting.name for setting in grid.settings], fontsize=8)
        if crowded:
            slant_names(panel)
        panel.set_xlim(-0.6, len(grid.settings) - 0.4)
        if measure.endswith("/kept"):
            panel.set_ylim(-0.03, 1.05)
        plain_axes(panel)
    figure.suptitle(f"{grid.name}: every seed, the mean and its 95 % interval", fontsize=11)
    return png(figure)


def draw_seeds(panel: Axes, place: int, numbers: Sequence[float] | np.ndarray, colour: str) -> None:
    """Every seed's number a dot, the mean a bar across them with its 95 % interval."""
    values = np.asarray(numbers)
    spread = np.linspace(-0.12, 0.12, len(values)) if len(values) > 1 else np.zeros(1)
    panel.plot(place + spread, values, "o", color=colour, markersize=4.5, alpha=0.75)
    estimate = statistics.mean(values)
    panel.plot([place - 0.25, place + 0.25], [estimate.value] * 2, color="black", linewidth=1.6)
    if estimate.low is not None and estimate.high is not None:
        panel.plot([place, place], [estimate.low, estimate.high], color="black", linewidth=1.2)


def curves_with_bands(grid: Grid, columns: Mapping[str, Mapping[str, Band]]) -> bytes | None:
    """One panel a logged column: the mean over seeds and its 95 % interval; None if nothing was logged."""
    if not columns:
        return None
    figure = Figure(figsize=(4.2 * len(columns), 3.4), layout="constrained")
    panels = figure.subplots(1, len(columns), squeeze=False)[0]
    places = {setting.name: place for place, setting in enumerate(grid.settings)}
    for panel, (column, settings) in zip(panels, columns.items(), strict=True):
        for setting, band in settings.items():
            _draw_band(panel, places[setting], setting, band)
        panel.set_title(column, fontsize=10)
        panel.set_xlabel("step", fontsize=9)
        plain_axes(panel)
    legend_below(figure, panels)
    return png(figure)


def learning_curves_figure(
    columns: Mapping[str, Mapping[str, Band]], shown_column: str = "", agent: str = "dqn"
) -> bytes | None:
    """One panel a fine-tuning: the mean over seeds and its 95 % interval, a line a setting; None if there are none.

    Args:
        columns: ``AGENT/NAME/COLUMN`` -> setting -> band, of one grid; other columns are left out. From
            :func:`repdib_lightning.experiments.curves.read_bands` of a report's curves.csv, for instance.
        shown_column: of each fine-tuning's progress, such as ``eval/success``; all by default.
        agent: whose columns.
    """
    parts = {name: name.split("/", 2) for name in columns}
    wanted = [name for name, (by, *rest) in parts.items() if by == agent and shown_column in ("", rest[-1])]
    shown = {name: columns[name] for name in wanted}
    if not shown:
        return None
    figure, panels = panel_grid(len(shown), 3, 4.2, 3.1)
    names = dict.fromkeys(setting for settings in shown.values() for setting in settings)
    places = {setting: place for place, setting in enumerate(names)}
    for panel, (name, settings) in zip(panels, shown.items(), strict=True):
        for setting, band in settings.items():
            _draw_band(panel, places[setting], setting, band)
        _, run, column = name.split("/", 2)
        panel.set_title(f"{run}: {column}", fontsize=10)
        panel.set_xlabel("step", fontsize=9)
        if column.rpartition("/")[2] in ("success", "coverage", "entropy"):
            panel.set_ylim(-0.03, 1.03)
        plain_axes(panel)
    legend_below(figure, panels)
    return png(figure)


def _draw_band(panel: Axes, place: int, setting: str, band: Band) -> None:
    colour, line = COLOURS[place % len(COLOURS)], _LINES[place // len(COLOURS) % len(_LINES)]
    draw_band(panel, band, f"{setting} (n={band.seeds})", colour, line)


def draw_band(panel: Axes, band: Band, label: str, colour: str, line: str = "-") -> None:
    """The mean over seeds and its interval."""
    panel.fill_between(band.steps, band.low, band.high, color=colour, alpha=0.2, linewidth=0)
    panel.plot(band.steps, band.mean, color=colour, linestyle=line, linewidth=1.3, label=label)


def legend_below(figure: Figure, panels: Sequence[Axes]) -> None:
    """Below all panels, in as many columns as the figure has room for; taken from the panel with most lines."""
    widest = max(panels, key=lambda panel: len(panel.get_legend_handles_labels()[0]))
    handles, labels = widest.get_legend_handles_labels()
    width, height = figure.get_size_inches()
    columns = max(1, min(len(labels), int(width / (0.6 + 0.075 * max(map(len, labels))))))
    figure.set_size_inches(width, height + 0.2 * (-(-len(labels) // columns) - 1))
    figure.legend(handles, labels, loc="outside lower center", ncols=columns, frameon=False, fontsize=9)


def codebook_use(uses: Mapping[str, Sequence[Mapping[str, list[float]]]], codes: int) -> bytes | None:
    """Codes in use and perplexity of each group: a dot a seed, a bar for the mean; None if no setting has codes.

    Args:
        uses: setting -> one record of ``used`` and ``perplexity`` (G numbers each) a seed.
        codes: L, drawn as a line.
    """
    if not uses:
        return None
    figure = Figure(figsize=(8.5, 2.1 * len(uses) + 0.7), layout="constrained")
    panels = figure.subplots(len(uses), 1, squeeze=False)[:, 0]
    for panel, (setting, seeds) in zip(panels, uses.items(), strict=True):
        for shift, (name, colour) in zip((-0.2, 0.2), (("used", COLOURS[4]), ("perplexity", COLOURS[0])), strict=True):
            values = np.array([seed[name] for seed in seeds])
            places = np.arange(values.shape[1]) + shift
            label = {"used": "codes in use", "perplexity": "perplexity (even use = codes in use)"}[name]
            panel.bar(places, values.mean(0), 0.38, color=colour, label=label)
            for row in values:
                panel.plot(places, row, ".", color="black", markersize=3)
        panel.axhline(codes, color="black", linestyle="--", linewidth=1, label="codes there are")
        panel.set_xticks(range(values.shape[1]))
        panel.set_title(f"{setting}: dots are seeds", fontsize=10, loc="left")
        plain_axes(panel)
    panels[-1].set_xlabel("group")
    handles, labels = panels[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=3, frameon=False)
    return png(figure)


def latent_maps(samples: Mapping[str, ProbeSamples], colours: Mapping[str, str]) -> bytes:
    """t-SNE of each setting's latents, side by side, one line a factor that colours them.

    Args:
        samples: setting -> its samples. colours: factor -> ``state`` or ``noise``.
    """
    size = (4.1 * len(samples) + 0.6, 3.8 * len(colours) + 0.3)
    figure = Figure(figsize=size, layout="constrained")
    panels = figure.subplots(len(colours), len(samples), squeeze=False)
    hints = {"state": "state: colours should separate", "noise": "noise: colours should mix"}
    for column, (setting, part) in enumerate(samples.items()):
        plane = tsne(part.latents)
        for line, (factor, kind) in enumerate(colours.items()):
            panel, values = panels[line, column], part.factors[factor]
            values = values if values.ndim == 1 else values[:, 0]
            classes = np.issubdtype(values.dtype, np.integer)
            dots = panel.scatter(*plane.T, c=values, cmap="turbo" if classes else "viridis", s=6, linewidths=0)
            if classes:
                number_classes(panel, plane, values)
            elif column == len(samples) - 1:
                figure.colorbar(dots, ax=panel, shrink=0.8)
            panel.set_title(f"{setting}, by {factor}\n({hints[kind]})", fontsize=10)
            panel.set_xticks([])
            panel.set_yticks([])
    return png(figure)
