"""What a report says of a grid whose fine-tunings begin at several snapshots of an exploration."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from repdib_lightning.evaluation.tables import Table
from repdib_lightning.experiments import statistics
from repdib_lightning.experiments.curves import Band
from repdib_lightning.experiments.exploration_figures import Valued, read_valued, snapshot_curves, value_maps
from repdib_lightning.experiments.page import Part
from repdib_lightning.experiments.results import Results
from repdib_lightning.experiments.snapshots import ALL, MONOTONE
from repdib_lightning.experiments.suite import SNAPSHOT, Finetune, Grid, Setting
from repdib_lightning.experiments.tables import NOTHING, interval

VALUES = "values.npz"
"""What a fine-tuning may write: latents that its agent met, and its critic's values."""

_RETURNS = {"return": "return at the end", "mean_return": "mean return of the curve"}
_RANK = "rank correlation"
_LEARNING = (
    "Learning curves: a line for each snapshot that fine-tuning began at, the mean over seeds and its 95 % bootstrap "
    "interval; dashed where nothing was pre-trained."
)
_RANKS = (
    "Rank correlation: Spearman's, of the frames of exploration before a snapshot and the return after fine-tuning "
    "from it, in each seed; 1 where more pre-training is always better, 0 where it makes no difference."
)


def exploration_parts(results: Results, grid: Grid, columns: Mapping[str, Mapping[str, Band]]) -> list[Part]:
    """One part with what the snapshots of a grid's explorations are worth; none without snapshots.

    Args:
        results: whose. grid: of it. columns: its curves.
    """
    finetune = _finetune_of(grid)
    if finetune is None:
        return []
    figures: dict[str, bytes] = {}
    sentences = [_told(finetune), *([_RANKS] if _ranked(finetune) else [])]
    for task, column in itertools.product(finetune.snapshots, results.suite.finetune_curves):
        drawn = snapshot_curves(*_bands(grid, finetune, columns, task, column), task=task, column=column)
        if drawn is not None:
            figures[f"{grid.name}-snapshots-{task}-{column.replace('/', '-')}"] = drawn
    if figures:
        sentences.append(_LEARNING)
    for task, runs in finetune.snapshots.items():
        seed, valued = _valued(results, grid, task, runs[max(runs)])
        drawn = value_maps(valued, task=task)
        if drawn is not None:
            figures[f"{grid.name}-values-{task}"] = drawn
            sentences.append(
                f"{task}: t-SNE of latents met after fine-tuning from the last snapshot, seed {seed}, coloured by the "
                "critic's value; the settings share one colour scale and have as many dots each."
            )
    return [Part(f"Exploration: {grid.name}", sentences, [snapshot_table(results, grid, finetune)], figures)]


def snapshot_table(results: Results, grid: Grid, finetune: Finetune) -> Table:
    """Returns by snapshot and setting, then the rank correlation of each fine-tuning and of all."""
    agent = finetune.agent
    rows: list[list[str]] = []
    rules: list[int] = []
    pretrained = [setting for setting in grid.settings if setting.pretrained]
    scratch = [setting for setting in grid.settings if not setting.pretrained]
    for task, runs in finetune.snapshots.items():
        rules.append(len(rows))
        for measure, label in _RETURNS.items():
            for frames, run in runs.items():
                cells = _cells(results, grid, pretrained, f"{agent}/{run}/{measure}", 1)
                rows.append([f"{task}: {label}, after {frames:,} frames", *cells])
            if scratch:
                cells = _cells(results, grid, scratch, f"{agent}/{task}/{measure}", 1)
                rows.append([f"{task}: {label}, from scratch", *cells])
        if _ranked(finetune):
            rows.append([f"{task}: {_RANK}", *_cells(results, grid, pretrained, f"{agent}/{task}/{MONOTONE}", 2)])
    if _ranked(finetune) and len(finetune.snapshots) > 1:
        rules.append(len(rows))
        rows.append([f"mean of all: {_RANK}", *_cells(results, grid, pretrained, f"{agent}/{ALL}/{MONOTONE}", 2)])
    return Table(["mean [95 % interval]", *(setting.name for setting in grid.settings)], rows, tuple(rules[1:]))


def _ranked(finetune: Finetune) -> bool:
    """Whether there are several snapshots to put in order."""
    return any(len(runs) > 1 for runs in finetune.snapshots.values())


def _cells(results: Results, grid: Grid, settings: Sequence[Setting], measure: str, digits: int) -> list[str]:
    """A cell for every setting of the grid, empty for those that the line is not about."""
    cells = []
    for setting in grid.settings:
        values = list(results.values(setting, measure).values()) if setting in settings else []
        cells.append(interval(statistics.mean(np.array(values)), digits) if values else NOTHING)
    return cells


def _finetune_of(grid: Grid) -> Finetune | None:
    """The fine-tunings that begin at snapshots: all pre-trained settings of a grid have the same."""
    found = (setting.finetune for setting in grid.settings if setting.pretrained)
    return next((finetune for finetune in found if finetune is not None and finetune.snapshots), None)


def _bands(
    grid: Grid, finetune: Finetune, columns: Mapping[str, Mapping[str, Band]], task: str, column: str
) -> tuple[dict[str, dict[int, Band]], dict[str, Band]]:
    """Setting -> frames -> band, and the same from scratch."""
    found: dict[str, dict[int, Band]] = {}
    for setting in grid.settings:
        for frames, run in finetune.snapshots[task].items():
            band = columns.get(f"{finetune.agent}/{run}/{column}", {}).get(setting.name)
            if band is not None:
                found.setdefault(setting.name, {})[frames] = band
    return found, dict(columns.get(f"{finetune.agent}/{task}/{column}", {}))


def _valued(results: Results, grid: Grid, task: str, last: str) -> tuple[int, dict[str, Valued]]:
    """The first seed whose values all settings that wrote any have, and these; -1 and nothing where there are none.

    Args:
        results, grid: whose. task: name of the run from scratch. last: of the run from the last snapshot.
    """
    found: dict[str, dict[int, Path]] = {}
    for setting in grid.settings:
        for seed in results.seeds:
            point = results.point(setting, seed)
            path = None if point is None else point.finetune_folder(last if setting.pretrained else task) / VALUES
            if path is not None and path.is_file():
                found.setdefault(setting.name, {})[seed] = path
    shared = [seed for seed in results.seeds if found and all(seed in paths for paths in found.values())]
    if not shared:
        return -1, {}
    return shared[0], {name: read_valued(paths[shared[0]]) for name, paths in found.items()}


def _told(finetune: Finetune) -> str:
    frames = sorted({count for runs in finetune.snapshots.values() for count in runs})
    counts = [f"{count:,}" for count in frames]
    tasks = []
    for task, runs in finetune.snapshots.items():
        options = {option: value for option, value in finetune.runs[runs[frames[-1]]].items() if option != SNAPSHOT}
        tasks.append(f"{task} ({', '.join(f'{option} {value}' for option, value in options.items())})")
    listed = " and ".join([", ".join(counts[:-1]), counts[-1]] if counts[:-1] else counts)
    return f"Fine-tuning by {finetune.agent} after {listed} frames of exploration: {'; '.join(tasks)}."
