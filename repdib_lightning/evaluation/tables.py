"""Tables of probe reports, for the terminal and for the HTML page."""

from __future__ import annotations

import html
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from repdib_lightning.evaluation.probe_report import Kind, ProbeReport

KINDS: dict[Kind, str] = {"endogenous": "state", "exogenous": "noise"}
"""What each kind of factor is called in front of a reader."""

FEW_EPISODES = 3


@dataclass(frozen=True)
class Table:
    """Cells as text: one header row, body rows, and the indices of body rows that a rule comes before."""

    header: list[str]
    rows: list[list[str]]
    rules: tuple[int, ...] = ()

    def text(self) -> str:
        """Columns padded with spaces: the first one to the right of its text, the others to the left."""
        widths = [max(len(row[c]) for row in [self.header, *self.rows]) for c in range(len(self.header))]
        line = "-" * (sum(widths) + 2 * (len(widths) - 1))
        shown = [_padded(self.header, widths), line]
        for i, row in enumerate(self.rows):
            shown += [line] * (i in self.rules) + [_padded(row, widths)]
        return "\n".join(shown)

    def html(self) -> str:
        """An HTML table; every cell is escaped."""
        head = "".join(f"<th>{html.escape(cell)}</th>" for cell in self.header)
        body = []
        for i, row in enumerate(self.rows):
            cells = "".join(f"<td>{html.escape(cell)}</td>" for cell in row)
            body.append(f'<tr class="rule">{cells}</tr>' if i in self.rules else f"<tr>{cells}</tr>")
        return f"<table><thead><tr>{head}</tr></thead><tbody>{''.join(body)}</tbody></table>"


def _padded(cells: Sequence[str], widths: Sequence[int]) -> str:
    padded = [cell.ljust(w) if i == 0 else cell.rjust(w) for i, (cell, w) in enumerate(zip(cells, widths, strict=True))]
    return "  ".join(padded).rstrip()


def number(value: float | None, digits: int = 3) -> str:
    """A fixed number of digits; ``-`` for None; never a negative zero."""
    return "-" if value is None else f"{round(value, digits) + 0.0:.{digits}f}"


def report_table(report: ProbeReport) -> str:
    """One representation: a row a factor, then the means, then what was measured on what."""
    header = ["factor", "kind", "measure", "chance"]
    for probe in report.probes:
        header += [probe, f"{probe} kept"]
    header += ["best group's bits"] * (report.codebook is not None)
    rows = []
    for name, factor in report.factors.items():
        row = [name, KINDS[factor.kind], factor.metric, number(factor.chance)]
        for probe in report.probes:
            row += [number(factor.probes[probe].score), number(factor.probes[probe].kept)]
        rows.append(row + _bits_cell(report, name))
    first_mean = len(rows)
    for kind, word in KINDS.items():
        if report.mean_kept(kind, report.probes[0]) is not None:
            row = [f"mean {word}", "", "", ""]
            for probe in report.probes:
                row += ["", number(report.mean_kept(kind, probe))]
            rows.append(row + [""] * (report.codebook is not None))
    if report.pictures is not None:
        rows += [_picture_row(report, name) for name in report.pictures.regions]
    blank = [""] * (len(header) - 5)
    rows += [[f"groups: {name}", "", "", "", number(value), *blank] for name, value in _group_figures(report).items()]
    table = Table(header, rows, (first_mean,)).text()
    return "\n".join([table, "", *notes({report.name: report})])


def _picture_row(report: ProbeReport, region: str) -> list[str]:
    assert report.pictures is not None
    score = report.pictures.regions[region]
    row = [f"picture: {region}", "", "error", number(1.0), number(score.error), number(score.kept)]
    return row + ["", ""] * (len(report.probes) - 1) + [""] * (report.codebook is not None)


def _bits_cell(report: ProbeReport, name: str) -> list[str]:
    bits = report.factors[name].bits
    if bits is None:
        return []
    best = int(np.argmax(bits.bits))
    return [f"{bits.bits[best]:.2f} of {bits.entropy:.2f} (group {best})"]


def comparison_table(reports: dict[str, ProbeReport]) -> Table:
    """Several representations side by side: score and kept of each factor, means, ratio to the first, codes used."""
    first = next(iter(reports.values()))
    probes = first.probes
    header = ["factor", "chance"]
    for run in reports:
        header += [f"{run}: {probes[0]}", *[f"{probe} kept" for probe in probes]]
    rows: list[list[str]] = []
    rules = []
    for kind, word in KINDS.items():
        names = [name for name, factor in first.factors.items() if factor.kind == kind]
        if not names:
            continue
        rules.append(len(rows))
        rows += [_factor_row(reports, name, word, probes) for name in names]
        rows.append(_mean_row(reports, kind, word, probes))
        if len(reports) > 1:
            rows.append(_ratio_row(reports, kind, word, probes))
    if first.pictures is not None:
        rules.append(len(rows))
        rows += [_region_row(reports, region, probes) for region in first.pictures.regions]
    if first.grouped is not None:
        rules.append(len(rows))
        figures = dict.fromkeys(name for report in reports.values() for name in _group_figures(report))
        rows += [_group_row(reports, name, probes) for name in figures]
    rules.append(len(rows))
    rows.append(_codes_row(reports, probes))
    return Table(header, rows, tuple(r for r in rules if r))


def _factor_row(reports: dict[str, ProbeReport], name: str, word: str, probes: list[str]) -> list[str]:
    factor = next(iter(reports.values())).factors[name]
    row = [f"{word}: {name} ({factor.metric})", number(factor.chance)]
    for report in reports.values():
        scores = report.factors[name].probes
        row += [number(scores[probes[0]].score), *[number(scores[probe].kept) for probe in probes]]
    return row


def _mean_row(reports: dict[str, ProbeReport], kind: Kind, word: str, probes: list[str]) -> list[str]:
    row = [f"{word}: mean kept", ""]
    for report in reports.values():
        row += ["", *[number(report.mean_kept(kind, probe)) for probe in probes]]
    return row


def _ratio_row(reports: dict[str, ProbeReport], kind: Kind, word: str, probes: list[str]) -> list[str]:
    """The paper prints its robot table relative to the run without bottleneck; so does this row."""
    name, base = next(iter(reports.items()))
    row = [f"{word}: relative to {name}", ""]
    for report in reports.values():
        row.append("")
        for probe in probes:
            ours, theirs = report.mean_kept(kind, probe), base.mean_kept(kind, probe)
            row.append(number(ours / theirs if ours is not None and theirs else None, 2))
    return row


def _region_row(reports: dict[str, ProbeReport], region: str, probes: list[str]) -> list[str]:
    row = [f"picture: {region} (error)", number(1.0)]
    for report in reports.values():
        assert report.pictures is not None, "all runs of a comparison get the same probes"
        score = report.pictures.regions[region]
        row += [number(score.error), number(score.kept), *[""] * (len(probes) - 1)]
    return row


def _group_figures(report: ProbeReport) -> dict[str, float | None]:
    return {} if report.grouped is None else report.grouped.figures()


def _group_row(reports: dict[str, ProbeReport], name: str, probes: list[str]) -> list[str]:
    row = [f"groups: {name}", ""]
    for report in reports.values():
        row += [number(_group_figures(report).get(name)), *[""] * len(probes)]
    return row


def _codes_row(reports: dict[str, ProbeReport], probes: list[str]) -> list[str]:
    row = ["codes used per group", ""]
    for report in reports.values():
        use = report.codebook
        row.append("-" if use is None else f"{np.mean(use.used):.1f} of {use.codes_per_group}")
        row += [""] * len(probes)
    return row


def notes(reports: dict[str, ProbeReport]) -> list[str]:
    """Plain sentences under a table: halves, codes, and classes that the fit half lacks."""
    first = next(iter(reports.values()))
    lines = [
        f"Fitted on {first.fit_rows} rows of evaluation episodes {_listed(first.fit_episodes)}, scored on "
        f"{first.score_rows} rows of episodes {_listed(first.score_episodes)} of {first.data}.",
        "kept = (score - chance) / (1 - chance), between 0 and 1. State should be kept, noise dropped.",
    ]
    if len(first.fit_episodes) < FEW_EPISODES:
        lines.append(
            f"Only {len(first.fit_episodes)} fit episode(s): what drifts slowly over the recording must be "
            "extrapolated, so what was kept of it is understated. Use data with more evaluation episodes."
        )
    if first.pictures is not None:
        lines.append(
            "picture: squared error of a decoder from the latent, relative to the mean picture; kept = 1 - error, "
            "in the column of the first probe."
        )
    if first.grouped is not None:
        lines.append("groups: what the groups hold and draw, in the column of the first probe.")
    for name, report in reports.items():
        if report.grouped is not None:
            found = report.grouped.disentanglement
            held = ", ".join(f"group {g} {factor or 'nothing beyond chance'}" for g, factor in enumerate(found.holds))
            lines.append(
                f"{name}: what each of {report.grouped.groups} groups holds most: {held} (codes: "
                f"{report.grouped.codes}; counted on {found.fit_rows + found.score_rows} rows, "
                f"learned on {found.fit_rows} training rows)."
            )
    for name, report in reports.items():
        use = report.codebook
        if use is not None:
            lines.append(
                f"{name}: {np.mean(use.used):.1f} of {use.codes_per_group} codes used per group "
                f"(perplexity {np.mean(use.perplexity):.1f}, {report.groups} groups). Bits are mutual information less "
                "the mean of 20 row permutations."
            )
    for name, factor in first.factors.items():
        if factor.unseen:
            lines.append(f"{name}: {factor.unseen:.1%} of scored rows have a class that the fit episodes lack (wrong).")
        if all(score.kept is None for score in factor.probes.values()):
            lines.append(f"{name}: does not vary in the scored episodes, so nothing can be said of it.")
    return lines


def _listed(episodes: list[int]) -> str:
    shown = ", ".join(map(str, episodes[:8]))
    return shown + (f", ... ({len(episodes)})" if len(episodes) > 8 else "")
