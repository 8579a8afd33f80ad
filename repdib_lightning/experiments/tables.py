"""The tables of a suite's report, as Markdown, HTML and CSV."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from pathlib import Path

from repdib_lightning.data.files import whole_file
from repdib_lightning.evaluation.tables import Table, number
from repdib_lightning.experiments.comparison import Difference, Summary, direction
from repdib_lightning.experiments.headline import FEWEST_SEEDS, READINGS, WHOLE, HeadlineLine, Verdict
from repdib_lightning.experiments.results import Results
from repdib_lightning.experiments.statistics import Estimate
from repdib_lightning.experiments.suite import Grid, Suite

ARROWS = {"up": " ↑", "down": " ↓", "": ""}
NOTHING = "-"
_VERDICTS = {True: "yes", False: "no", None: NOTHING}


def markdown(table: Table) -> str:
    """A Markdown table, its first column to the left and the others to the right."""
    rule = ["---", *["---:"] * (len(table.header) - 1)]
    rows = [table.header, rule, *table.rows]
    return "\n".join(f"| {' | '.join(row)} |" for row in rows)


def interval(estimate: Estimate | None, digits: int = 3, signed: bool = False) -> str:
    """``0.674 [0.655, 0.690]``; without brackets for one seed; ``-`` for None."""
    if estimate is None:
        return NOTHING
    sign = "+" if signed and round(estimate.value, digits) > 0 else ""
    shown = f"{sign}{number(estimate.value, digits)}"
    if estimate.low is None or estimate.high is None:
        return shown
    return f"{shown} [{number(estimate.low, digits)}, {number(estimate.high, digits)}]"


def headline_tables(results: Results, lines: Sequence[HeadlineLine]) -> list[Table]:
    """The paper's rows beside ours: whole measures as they are, then what is relative to the baseline, and absolute."""
    whole = [line for line in lines if line.reading == WHOLE]
    relative = [line for line in lines if line.reading != WHOLE]
    shown = [whole_table(results, whole)] if whole else []
    return [*shown, headline_table(results, relative), absolute_table(results, relative)] if relative else shown


def whole_table(results: Results, lines: Sequence[HeadlineLine]) -> Table:
    """The paper's rows: printed values, then ours in the same unit."""
    grids = [results.suite.grid(line.row.grid) for line in lines]
    settings = list(dict.fromkeys(setting.name for grid in grids for setting in grid.settings))
    rows = []
    for line in lines:
        paper = [number(line.row.paper[s], 4) if s in line.row.paper else NOTHING for s in settings]
        shown = [interval(line.cells[s].absolute) if s in line.cells else NOTHING for s in settings]
        rows += [[f"{line.row.label}: paper", *paper, ""], [f"{line.row.label}: here", *shown, _VERDICTS[line.agrees]]]
    return Table(["", *settings, "paper's order"], rows, tuple(range(2, len(rows), 2)))


def headline_table(results: Results, lines: Sequence[HeadlineLine]) -> Table:
    """The paper's rows: printed values, then ours in both readings, relative to the baseline."""
    settings = [setting.name for setting in results.suite.grids[0].settings]
    rows: list[list[str]] = []
    rules = []
    for line in lines:
        if line.reading == next(iter(READINGS)):
            rules.append(len(rows))
            paper = [number(line.row.paper[s], 4) if s in line.row.paper else NOTHING for s in settings]
            rows.append([f"{line.row.label}: paper", *paper, ""])
        shown = [interval(line.cells[s].relative) if s in line.cells else NOTHING for s in settings]
        rows.append([f"{line.row.label}: {READINGS[line.reading]}", *shown, _VERDICTS[line.agrees]])
    return Table(["relative to " + results.suite.grids[0].baseline, *settings, "paper's order"], rows, tuple(rules[1:]))


def absolute_table(results: Results, lines: Sequence[HeadlineLine]) -> Table:
    """The same numbers, not relative."""
    settings = [setting.name for setting in results.suite.grids[0].settings]
    rows = [
        [f"{line.row.label}: {READINGS[line.reading]}"]
        + [interval(line.cells[s].absolute) if s in line.cells else NOTHING for s in settings]
        for line in lines
    ]
    return Table(["absolute", *settings], rows)


def summary_table(results: Results, grid: Grid, found: Sequence[Summary], measures: Sequence[str]) -> Table:
    """Mean (interquartile mean) [95 % interval of the mean] of every setting."""
    cells = {(row.setting, row.measure): row for row in found}
    names = [setting.name for setting in grid.settings]
    seeds = {name: max((row.n for row in found if row.setting == name), default=0) for name in names}
    header = ["mean (IQM) [95 % interval]", *[f"{name} (n={seeds[name]})" for name in names]]
    rows = []
    for measure in measures:
        row = [measure + ARROWS[direction(measure, results.factors)]]
        row += [_summary_cell(cells.get((name, measure)), seeds[name]) for name in names]
        rows.append(row)
    return Table(header, rows)


def _summary_cell(row: Summary | None, seeds: int) -> str:
    """A measure that some of the seeds lack says of how many it is."""
    if row is None:
        return NOTHING
    value, _, rest = interval(row.mean).partition(" ")
    fewer = f"n={row.n}" if row.n < seeds else ""
    return " ".join(part for part in (value, f"({number(row.iqm.value)})", rest, fewer) if part)


def difference_table(results: Results, grid: Grid, found: Sequence[Difference], measures: Sequence[str]) -> Table:
    """Difference from the baseline, seeds in pairs, and the probability of improvement."""
    cells = {(row.setting, row.measure): row for row in found}
    names = [setting.name for setting in grid.settings if setting.name != grid.baseline]
    rows = []
    for measure in measures:
        row = [measure + ARROWS[direction(measure, results.factors)]]
        for name in names:
            cell = cells.get((name, measure))
            row += [NOTHING if cell is None else interval(cell.difference, signed=True)]
            told = cell is not None and cell.n > 1  # one run above another says nothing of the next
            row += [interval(cell.better, 2) if cell is not None and told else NOTHING]
        if set(row[1:]) != {NOTHING}:
            rows.append(row)
    header = [f"minus {grid.baseline}"]
    for name in names:
        header += [name, f"P({name} better)"]
    return Table(header, rows)


_JUDGED_BY = {"mean": "", "whole": ", whole interval", "any": ", some of it", "interval": ", by the interval"}


def claims_table(found: Sequence[Verdict], suite: Suite) -> Table:
    """Each claim, its number, and whether it holds."""
    rows = []
    for verdict in found:
        claim = verdict.claim
        bounds = [f"at most {claim.at_most}"] * (claim.at_most is not None)
        bounds += [f"at least {claim.at_least}"] * (claim.at_least is not None)
        few = 0 < verdict.seeds < FEWEST_SEEDS
        asked = " and ".join(bounds) + (", in the mean" if few and claim.judge == "mean" else _JUDGED_BY[claim.judge])
        holds = {True: "holds", False: "FAILS", None: "cannot be told"}[verdict.holds]
        grid = suite.grid(claim.grid)
        other = "" if claim.of == "value" else f" against {claim.than or grid.baseline}"
        where = "" if grid is suite.grids[0] else f" (grid {grid.name})"
        seeds = f", {verdict.seeds} seeds" if few else ""
        about = f"{claim.of} of {claim.measure}, {claim.setting}{other}{where}{seeds}"
        rows.append([claim.text, about, interval(verdict.estimate), asked, holds])
    return Table(["claim", "measured by", "found", "asked for", ""], rows)


def write_summaries(path: Path, found: Sequence[Summary]) -> None:
    """Every measure of every setting as CSV."""
    header = ["grid", "setting", "measure", "n", "mean", "mean_low", "mean_high", "iqm", "iqm_low", "iqm_high"]
    rows = [[r.grid, r.setting, r.measure, r.n, *_three(r.mean), *_three(r.iqm)] for r in found]
    _write(path, header, rows)


def write_differences(path: Path, found: Sequence[Difference]) -> None:
    """Every measure held against the baseline as CSV."""
    header = ["grid", "setting", "baseline", "measure", "n"]
    for name in ("difference", "ratio", "better"):
        header += [name, f"{name}_low", f"{name}_high"]
    rows = [
        [r.grid, r.setting, r.baseline, r.measure, r.n, *_three(r.difference), *_three(r.ratio), *_three(r.better)]
        for r in found
    ]
    _write(path, header, rows)


def _three(estimate: Estimate | None) -> list[str]:
    values = (None,) * 3 if estimate is None else (estimate.value, estimate.low, estimate.high)
    return ["" if value is None else f"{value:.6g}" for value in values]


def _write(path: Path, header: list[str], rows: Sequence[Sequence[object]]) -> None:
    with whole_file(path) as aside, open(aside, "w", newline="") as file:
        table = csv.writer(file)
        table.writerow(header)
        table.writerows(rows)
