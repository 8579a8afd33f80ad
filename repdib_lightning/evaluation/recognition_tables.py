"""Tables of how well classes are recognised, for the terminal and for the page of a comparison."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

from repdib_lightning.evaluation.recognition_pass import FUSED
from repdib_lightning.evaluation.tables import Table, number

if TYPE_CHECKING:
    from repdib_lightning.evaluation.recognition import RecognitionReport, Scores

SCORES = {"f1_macro": "macro F1", "f1_micro": "micro F1", "f1_weighted": "weighted F1", "accuracy": "accuracy"}
_EXTREMES = 3
MACRO_NOTE = "Macro F1 is the mean over the classes that occur in these clips or were predicted for one."


def recognition_text(report: RecognitionReport) -> str:
    """One classifier: with everything there and with modalities missing, its worst and best classes."""
    return "\n".join([_table(report).text(), "", *recognition_notes({"": report})])


def _table(report: RecognitionReport) -> Table:
    shares, codes = report.attention, report.perplexity
    header = [f"recognition of {report.target}", *SCORES.values()]
    header += ["mean weight"] * bool(shares) + ["codes' perplexity"] * bool(codes)

    def line(label: str, scores: list[str], name: str) -> list[str]:
        weight = [number(shares[name]) if name in shares else ""] * bool(shares)
        return [label, *scores, *weight, *([number(codes[name], 1) if name in codes else ""] * bool(codes))]

    rows = [line("with everything there", _cells(report.scores), FUSED)]
    rules = [1]
    rows += [line(f"without {name}", _cells(scores), name) for name, scores in report.without.items()]
    rules.append(len(rows))
    rows += [line(f"{name} alone", [number(score), "", "", ""], "") for name, score in report.only.items()]
    rules.append(len(rows))
    rows += [line(f"F1 of {name}", [number(score), "", "", ""], "") for name, score in extremes(report)]
    return Table(header, rows, tuple(sorted({rule for rule in rules if rule < len(rows)})))


def _cells(scores: Scores) -> list[str]:
    return [number(getattr(scores, name)) for name in SCORES]


def extremes(report: RecognitionReport) -> list[tuple[str, float]]:
    """The worst three and the best three classes with their F1, the worst first; all where there are at most six."""
    ranked = sorted(((name, f1) for name, f1 in report.f1.items() if f1 is not None), key=lambda pair: pair[1])
    return ranked if len(ranked) <= 2 * _EXTREMES else ranked[:_EXTREMES] + ranked[-_EXTREMES:]


def recognition_comparison(reports: Mapping[str, RecognitionReport]) -> Table:
    """Several classifiers side by side: four scores, macro F1 without each modality and with it alone, worst class."""
    first = next(iter(reports.values()))
    header = [f"recognition of {first.target}", *reports]
    names = list(dict.fromkeys(name for report in reports.values() for name in report.without))
    rows = [
        [label, *[number(getattr(report.scores, score)) for report in reports.values()]]
        for score, label in SCORES.items()
    ]
    rules = [len(rows)]
    rows += [
        [f"macro F1 without {name}", *[_macro(report.without.get(name)) for report in reports.values()]]
        for name in names
    ]
    rules.append(len(rows))
    rows += [
        [f"macro F1 of {name} alone", *[number(report.only.get(name)) for report in reports.values()]] for name in names
    ]
    rules.append(len(rows))
    rows.append(["worst class", *[_named(extremes(report)[0]) for report in reports.values()]])
    return Table(header, rows, tuple(sorted(set(rules))))


def _macro(scores: Scores | None) -> str:
    return number(None if scores is None else scores.f1_macro)


def _named(pair: tuple[str, float]) -> str:
    return f"{pair[0]} ({number(pair[1])})"


def recognition_notes(reports: Mapping[str, RecognitionReport]) -> list[str]:
    """Plain sentences under a table: how many clips, and what macro F1 is a mean of."""
    first = next(iter(reports.values()))
    return [
        f"Scored on all {first.clips} held-out clips, nothing was fitted; naming the most frequent class each time "
        f"has macro F1 {number(first.chance)}.",
        MACRO_NOTE,
    ]
