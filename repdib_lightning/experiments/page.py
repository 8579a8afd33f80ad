"""A suite's report as text: its parts, as Markdown and as sections of the HTML page."""

from __future__ import annotations

import html
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from repdib_lightning.evaluation.report import Section, film, picture
from repdib_lightning.evaluation.tables import Table
from repdib_lightning.experiments.results import Results
from repdib_lightning.experiments.tables import markdown

WIDE = 6


@dataclass(frozen=True)
class Part:
    """One part of the report: a heading with sentences, tables, figures (file name -> PNG) and films (-> MP4)."""

    title: str
    sentences: list[str]
    tables: list[Table]
    figures: dict[str, bytes]
    films: dict[str, bytes] = field(default_factory=dict)


def facts_of(results: Results) -> list[str]:
    """Sentences on what was run, with what, for how long, and what is missing."""
    first = next(iter(results.records.values()))
    versions = ", ".join(f"{name} {number}" for name, number in first.versions.items())
    seconds = sum(sum(record.seconds.values()) for record in results.records.values())
    facts = [
        f"{len(results.records)} runs of suite '{results.suite.name}', seeds {', '.join(map(str, results.seeds))}"
        f"{_stores(results)}, {first.threads} thread(s) each, {seconds / 3600:.1f} hours of run time in all.",
        f"Versions: {versions}.",
        "Probes are fitted on some held-out episodes and scored on others. Intervals: 95 %, bootstrap over seeds "
        "(percentile, 10,000 resamples); with five seeds they are somewhat too narrow.",
    ]
    if len(results.seeds) == 1:
        facts.append("ONE SEED: nothing here has a spread; read it as an anecdote.")
    if results.missing:
        facts.append(f"NOT FINISHED, and left out: {', '.join(results.missing)}.")
    others = {json.dumps(record.versions, sort_keys=True) for record in results.records.values()}
    if len(others) > 1:
        facts.append("The runs were made with different versions; points.jsonl has each one's.")
    return facts


def _stores(results: Results) -> str:
    """What the encoders were trained on; nothing where there are none."""
    pairs = [(point.setting, results.records[key]) for key, point in results.points.items()]
    given = [record.data for setting, record in pairs if record.data and not setting.explores]
    probed = [record.probed for setting, record in pairs if record.probed and not setting.explores]
    explored = [record.probed for setting, record in pairs if setting.explores]
    told = f", on {_listed(given)}" if given else ""
    told += f", probed on {_listed(probed)}" if probed else ""
    return told + f", each exploration on a replay of its own and probed on {_listed(explored)}" if explored else told


def _listed(stores: Sequence[Mapping[str, str]]) -> str:
    """Every store once."""
    told = [f"{store.get('file')} (fingerprint {store.get('fingerprint')})" for store in stores]
    return " and ".join(dict.fromkeys(told))


def as_markdown(title: str, facts: Sequence[str], parts: Sequence[Part]) -> str:
    """The whole report; figures are files beside it."""
    blocks = [f"# {title}", *facts]
    for part in parts:
        blocks += [f"## {part.title}", *part.sentences, *[markdown(table) for table in part.tables]]
        blocks += [f"![{name}]({name}.png)" for name in part.figures]
        blocks += [f"[{name}]({name}.mp4)" for name in part.films]
    return "\n\n".join(blocks) + "\n"


def as_section(part: Part) -> Section:
    """One part of the HTML page, its figures inside."""
    body = [f"<p>{html.escape(sentence)}</p>" for sentence in part.sentences]
    body += [f'<div class="{_width(table)}">{table.html()}</div>' for table in part.tables]
    body += [picture(content, name) for name, content in part.figures.items()]
    body += [film(content, name) for name, content in part.films.items()]
    return Section(part.title, "\n".join(body))


def _width(table: Table) -> str:
    """A table of many columns of numbers is pushed sideways under its first column instead of breaking its cells."""
    return "wide numbers" if len(table.header) > WIDE else "wide"
