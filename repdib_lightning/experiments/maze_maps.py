"""Maps of mazes after fine-tuning: where the agents were, and how far the encoders take the cells to be."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.colors import Normalize, PowerNorm
from matplotlib.figure import Figure
from matplotlib.image import AxesImage

from repdib_lightning.data.files import whole_file
from repdib_lightning.environments.maze_pictures import wall_lines
from repdib_lightning.environments.mazes import WORLDS, Maze, build_maze
from repdib_lightning.errors import UserError
from repdib_lightning.evaluation.figures import png
from repdib_lightning.experiments.points import OUTCOME, Point
from repdib_lightning.experiments.results import Results
from repdib_lightning.experiments.suite import Grid

DIGITS = 4
"""Significant digits in the file."""

PATH = "shortest path"
"""Heading of the column that the encoders' distances are held against."""

_KINDS = ("visits", "latent_distance", "path_length")


@dataclass(frozen=True)
class MeanMaps:
    """Maps of one setting after one fine-tuning, each (size, size), mean over seeds; None for what was not measured.

    Attributes:
        environment: the maze. seeds: how many.
        visits: share of the training steps in each cell; sums to 1.
        latent_distance: of each cell's latent from the centre's, each seed's relative to its largest.
        path_length: moves from each cell to the centre.
        topology: rank correlation of the last two.
    """

    environment: str
    seeds: int
    visits: np.ndarray | None = None
    latent_distance: np.ndarray | None = None
    path_length: np.ndarray | None = None
    topology: float | None = None

    def maze(self) -> Maze:
        """The maze, of the maps' size."""
        size = next(
            len(values) for values in (self.visits, self.latent_distance, self.path_length) if values is not None
        )
        return build_maze(self.environment, size)


Maps = dict[str, dict[str, MeanMaps]]
"""Name of a fine-tuning -> setting -> maps."""


def mean_maps(results: Results, grid: Grid) -> Maps:
    """Maps of the settings that the suite shows; empty where nothing was fine-tuned in a maze.

    Raises:
        UserError: a finished fine-tuning's outcome is missing or damaged.
    """
    found: Maps = {}
    for setting in grid.settings:
        if setting.finetune is None or (results.suite.maps and setting.name not in results.suite.maps):
            continue
        points = [point for seed in results.seeds if (point := results.point(setting, seed)) is not None]
        for name in setting.finetune.runs:
            outcomes = [_outcome(point, name) for point in points]
            mapped = [o for o in outcomes if o["environment"] in WORLDS and any(o["maps"].get(k) for k in _KINDS)]
            if mapped:
                found.setdefault(name, {})[setting.name] = _mean(mapped)
    return found


def write_maps(path: Path, grids: Mapping[str, Maps]) -> None:
    """Write grid -> fine-tuning -> setting -> maps as JSON, rounded to :data:`DIGITS` digits."""
    content = {
        grid: {name: {s: _as_json(part) for s, part in settings.items()} for name, settings in maps.items()}
        for grid, maps in grids.items()
    }
    with whole_file(path) as aside:
        aside.write_text(json.dumps(content) + "\n")


def read_maps(path: Path) -> dict[str, Maps]:
    """Grid -> fine-tuning -> setting -> maps, as :func:`write_maps` wrote them.

    Raises:
        UserError: no such file, or it is another one.
    """
    try:
        grids = json.loads(Path(path).read_text())
        return {
            grid: {name: {s: _from_json(part) for s, part in settings.items()} for name, settings in maps.items()}
            for grid, maps in grids.items()
        }
    except (OSError, ValueError, TypeError, KeyError, AttributeError) as error:
        raise UserError(f"{path}: not the maps of a report ({type(error).__name__}: {error})") from error


def coverage_figure(maps: Maps) -> bytes | None:
    """Share of the visits to each cell: a line a fine-tuning, a column a setting; None where nothing was counted.

    The colour scale goes with the square root, so that cells that were seldom visited differ from those that never
    were; it is the same for all panels.
    """
    shown = {name: settings for name, settings in _having(maps, "visits").items() if settings}
    if not shown:
        return None
    highest = max(float(_known(part.visits).max()) for settings in shown.values() for part in settings.values())
    scale = PowerNorm(0.5, vmin=0.0, vmax=highest)

    def draw(panel: Axes, part: MeanMaps, column: str) -> AxesImage:
        panel.set_title(column, fontsize=9)
        return _draw(panel, part, _known(part.visits), scale)

    columns = list(dict.fromkeys(setting for settings in shown.values() for setting in settings))
    return _panels(shown, columns, draw, "share of the visits (square-root scale)")


def topology_figure(maps: Maps) -> bytes | None:
    """Distance of each cell from the centre: the shortest path, then each setting's latent; None where there is none.

    Each map is shown relative to its largest value; a circle marks the centre, ``rho`` is the mean over seeds of the
    rank correlation with the shortest path.
    """
    shown = {name: settings for name, settings in _having(maps, "latent_distance").items() if settings}
    if not shown:
        return None
    scale = Normalize(0.0, 1.0)

    def draw(panel: Axes, part: MeanMaps, column: str) -> AxesImage:
        values = _known(part.path_length if column == PATH else part.latent_distance)
        row, place = part.maze().place(part.maze().centre)
        panel.plot(place + 0.5, row + 0.5, "o", markersize=6, markerfacecolor="none", markeredgecolor="red")
        told = "" if column == PATH or part.topology is None else f"\nrho = {part.topology:.2f}"
        panel.set_title(f"{column}{told}", fontsize=9)
        return _draw(panel, part, _relative(values), scale)

    columns = list(dict.fromkeys(setting for settings in shown.values() for setting in settings))
    cells = {}
    for name, settings in shown.items():
        measured = [part for part in settings.values() if part.path_length is not None]
        cells[name] = {**({PATH: measured[0]} if measured else {}), **settings}
    return _panels(cells, [PATH, *columns], draw, "distance from the centre, relative to the largest")


def _panels(
    cells: Mapping[str, Mapping[str, MeanMaps]],
    columns: list[str],
    draw: Callable[[Axes, MeanMaps, str], AxesImage],
    label: str,
) -> bytes:
    """A line a fine-tuning with its name at the left, a panel a column that it has, and one colour bar."""
    figure = Figure(figsize=(1.75 * len(columns) + 1.4, 1.95 * len(cells) + 0.3), layout="constrained")
    panels = figure.subplots(len(cells), len(columns), squeeze=False)
    for line, (name, parts) in zip(panels, cells.items(), strict=True):
        for panel, column in zip(line, columns, strict=True):
            panel.set(xticks=[], yticks=[])
            panel.spines[:].set_visible(False)
            if column in parts:
                picture = draw(panel, parts[column], column)
        line[0].set_ylabel(name, fontsize=9)
    figure.colorbar(picture, ax=panels, label=label, fraction=0.02)
    return png(figure)


def _draw(panel: Axes, part: MeanMaps, values: np.ndarray, scale: Normalize) -> AxesImage:
    maze = part.maze()
    picture = panel.imshow(values, cmap="YlGnBu", norm=scale, extent=(0, maze.size, maze.size, 0))
    walls = [[(column, row) for row, column in line] for line in wall_lines(maze)]
    panel.add_collection(LineCollection(walls, colors="black", linewidths=1.6, clip_on=False))
    return picture


def _having(maps: Maps, kind: str) -> Maps:
    """The settings that have one of the maps."""
    return {
        name: {setting: part for setting, part in settings.items() if getattr(part, kind) is not None}
        for name, settings in maps.items()
    }


def _known(values: np.ndarray | None) -> np.ndarray:
    assert values is not None
    return values


def _outcome(point: Point, name: str) -> dict[str, Any]:
    path = point.finetune_folder(name) / OUTCOME
    try:
        outcome = json.loads(path.read_text())
        return {"environment": outcome["environment"], "measures": outcome["measures"], "maps": outcome["maps"]}
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise UserError(f"{path}: not the outcome of a fine-tuning ({type(error).__name__}: {error})") from error


def _mean(outcomes: list[dict[str, Any]]) -> MeanMaps:
    """Over seeds of one setting and one fine-tuning. Without a goal the latents' distances are left out: the encoder
    never saw the picture that they are measured in.
    """
    prepare = {"visits": _shares, "latent_distance": _relative}
    found: dict[str, Any] = {}
    for kind in _KINDS:
        each = [np.array(outcome["maps"][kind], float) for outcome in outcomes if outcome["maps"].get(kind)]
        each = [prepare[kind](values) for values in each] if kind in prepare else each
        if kind != "visits" and not any("success" in outcome["measures"] for outcome in outcomes):
            each = []
        found[kind] = np.mean(each, axis=0) if each else None
    correlations = [o["measures"]["topology"] for o in outcomes if o["measures"].get("topology") is not None]
    topology = float(np.mean(correlations)) if correlations else None
    return MeanMaps(outcomes[0]["environment"], len(outcomes), topology=topology, **found)


def _shares(visits: np.ndarray) -> np.ndarray:
    return visits / max(visits.sum(), 1.0)


def _relative(distance: np.ndarray) -> np.ndarray:
    """An encoder that gives all cells one latent has no distances."""
    return distance / distance.max() if distance.max() > 0 else distance


def _as_json(part: MeanMaps) -> dict[str, Any]:
    content: dict[str, Any] = {"environment": part.environment, "seeds": part.seeds}
    for kind in _KINDS:
        values = getattr(part, kind)
        if values is not None:
            content[kind] = [[_rounded(value) for value in row] for row in values]
    return content if part.topology is None else {**content, "topology": _rounded(part.topology)}


def _from_json(content: dict[str, Any]) -> MeanMaps:
    maps = {kind: np.array(content[kind], float) for kind in _KINDS if kind in content}
    return MeanMaps(content["environment"], content["seeds"], topology=content.get("topology"), **maps)


def _rounded(value: float) -> float:
    return float(f"{value:.{DIGITS}g}")
