"""Compares frozen encoders on one data set: a table for the terminal, and one self-contained HTML page."""

from __future__ import annotations

import base64
import html
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from repdib_lightning.data.episodes import EpisodeStore
from repdib_lightning.data.files import whole_file
from repdib_lightning.data.outputs import check_output_file
from repdib_lightning.errors import UserError
from repdib_lightning.evaluation import curves, figures
from repdib_lightning.evaluation.bundles import protected_files
from repdib_lightning.evaluation.decoder import Drawings
from repdib_lightning.evaluation.features import check_compatible
from repdib_lightning.evaluation.group_probe import check_grouped
from repdib_lightning.evaluation.probe import (
    RECOGNITION,
    Encoded,
    check_options,
    encode_evaluation,
    load_for_probing,
    load_to_recognise,
    open_for_probing,
    probe_encoded,
    probe_groups,
    probe_recognition,
)
from repdib_lightning.evaluation.probe_report import ProbeReport
from repdib_lightning.evaluation.probes import GROUPS, PROBES
from repdib_lightning.evaluation.recognition_confusion import confusion_matrix
from repdib_lightning.evaluation.recognition_modalities import modality_bars
from repdib_lightning.evaluation.recognition_tables import recognition_comparison, recognition_notes
from repdib_lightning.evaluation.splits import rows_of
from repdib_lightning.evaluation.tables import comparison_table, notes

if TYPE_CHECKING:
    from repdib_lightning.evaluation.recognition import RecognitionReport
    from repdib_lightning.evaluation.recognition_pass import Tells
    from repdib_lightning.export import FrozenEncoder

SCATTERED = 2000
STYLE = """
body { font: 16px/1.5 system-ui, sans-serif; max-width: 62rem; margin: 2rem auto; padding: 0 1rem; color: #222; }
h1 { font-size: 1.6rem; } h2 { font-size: 1.2rem; margin-top: 2.2rem; border-bottom: 1px solid #ddd; }
img { max-width: 100%; } .wide { overflow-x: auto; } .numbers td, .numbers th { white-space: nowrap; }
.numbers td:first-child, .numbers th:first-child { position: sticky; left: 0; background: #fff; }
table { border-collapse: collapse; font-size: .88rem; font-variant-numeric: tabular-nums; }
th, td { padding: .25rem .7rem; text-align: right; } th:first-child, td:first-child { text-align: left; }
thead th, tr.rule td { border-top: 1px solid #888; } thead th { border-bottom: 1px solid #888; }
pre { background: #f5f5f5; padding: .8rem; overflow-x: auto; font-size: .85rem; }
.note { color: #555; font-size: .9rem; }
"""


@dataclass(frozen=True)
class Section:
    """One heading of the page with its HTML body."""

    title: str
    body: str


@dataclass(frozen=True)
class RunResult:
    """One frozen encoder, probed.

    Attributes:
        report: what it kept. encoded: its evaluation latents, or None to leave out the scatter.
        description: plain facts of encoder, bottleneck and training (the bundle's ``config.json``).
        metrics: the run's ``metrics.csv``, or None. bundle: the folder to load it from.
        drawings: pictures drawn again from the latents, or None.
    """

    report: ProbeReport
    encoded: Encoded | None = None
    description: Mapping[str, Any] | None = None
    metrics: Path | None = None
    bundle: Path | None = None
    drawings: Drawings | None = None


def compare(
    bundles: Mapping[str, Path],
    data: Path,
    output: Path,
    *,
    metrics: Mapping[str, Path] | None = None,
    title: str = "What the representation kept and dropped",
    probes: str | Sequence[str] = PROBES,
    groups: int | None = None,
    device: str = "auto",
    seed: int = 0,
    progress: bool = True,
) -> str:
    """Probe several bundles on one data set, write the HTML page, and return the table for the terminal.

    Args:
        bundles: run name -> folder of an exported encoder; ratios are relative to the first.
        data: a store with factors and at least two evaluation episodes.
        output: the HTML file (.html). Beside it ``<stem>.json`` holds every report in full, ``<stem>-kept.png`` the
            bars; files of these names are replaced.
        metrics: run name -> metrics.csv, for the training curves.
        title, probes, groups, device, seed, progress: as in :func:`repdib_lightning.evaluation.probe.probe_bundle`.

    Raises:
        UserError: as ``probe_bundle`` does; nothing is written then. All bundles are read before any is probed.
    """
    if not bundles:
        raise UserError("compare: at least one bundle is needed")
    chosen = check_options(probes, seed, groups)
    output, data, metrics = Path(output), Path(data), metrics or {}
    check_outputs(output, [data, *(file for bundle in bundles.values() for file in protected_files(Path(bundle)))])
    encoders = {name: load_for_probing(Path(bundle), device) for name, bundle in bundles.items()}
    for path in metrics.values():
        curves.read_curves(path)
    named = {str(bundles[name]): encoder.description for name, encoder in encoders.items()}
    store = open_for_probing(data, chosen, named)
    all_quantised = all(encoder.groups for encoder in encoders.values())
    cuts = {name: groups if all_quantised or not encoder.groups else None for name, encoder in encoders.items()}
    for name, encoder in encoders.items():
        check_compatible(encoder, store, str(bundles[name]))
        if GROUPS in chosen:
            check_grouped(encoder, cuts[name])
    asked = encoders if RECOGNITION in chosen else {}
    classifiers = {name: load_to_recognise(Path(bundles[name]), encoder, store) for name, encoder in asked.items()}
    runs = {}
    for name, encoder in encoders.items():
        place = Path(bundles[name])
        options = {"seed": seed, "progress": progress}
        found = _probed(name, encoder, classifiers.get(name), place, store, chosen, cuts[name], options)
        runs[name] = replace(found, metrics=metrics.get(name))
    write_comparison(output, runs, store, title=title)
    reports = {name: run.report for name, run in runs.items()}
    lines = [comparison_table(reports).text(), "", *notes(reports)]
    recognised = _recognised(reports)
    if recognised:
        lines += ["", recognition_comparison(recognised).text(), "", *recognition_notes(recognised)]
    return "\n".join(lines)


def _probed(
    name: str,
    encoder: FrozenEncoder,
    classifier: Tells | None,
    bundle: Path,
    store: EpisodeStore,
    probes: tuple[str, ...],
    groups: int | None,
    options: dict[str, Any],
) -> RunResult:
    """One of the bundles that are compared."""
    encoded = encode_evaluation(encoder, store, device=encoder.device, progress=options["progress"])
    report, drawings = probe_encoded(encoded, store, name=name, probes=probes, **options)
    if GROUPS in probes:
        report = replace(report, grouped=probe_groups(encoder, bundle, store, groups=groups, **options))
    if classifier is not None:
        recognition = probe_recognition(encoder, classifier, store, progress=options["progress"])
        report = replace(report, recognition=recognition)
    return RunResult(report, encoded, encoder.description, bundle=bundle, drawings=drawings)


def check_outputs(output: Path, inputs: Sequence[Path]) -> None:
    """Check that the page and the two files beside it can be written. Raises UserError naming OUTPUT."""
    check_output_file(output, "OUTPUT", ".html", inputs)
    for path in beside(output):
        check_output_file(path, "OUTPUT's side file", path.suffix, inputs)


def beside(output: Path) -> tuple[Path, Path]:
    """The numbers and the bars; not ``<stem>.png``, which is the contact sheet of a data set of that name."""
    return output.with_suffix(".json"), output.with_name(f"{output.stem}-kept.png")


def write_comparison(output: Path, runs: Mapping[str, RunResult], store: EpisodeStore, *, title: str) -> None:
    """Write the page of several probed runs; beside it the numbers and the bars of kept."""
    output = Path(output)
    reports = {name: run.report for name, run in runs.items()}
    plain = json.dumps({name: report.to_dict() for name, report in reports.items()}, indent=2, allow_nan=False)
    sections = comparison_sections(runs, store)
    numbers, bars = beside(output)
    with whole_file(numbers) as aside:
        aside.write_text(plain + "\n")
    with whole_file(bars) as aside:
        aside.write_bytes(figures.kept_bars(reports))
    write_report(output, title, sections)


def write_report(path: Path, title: str, sections: list[Section]) -> None:
    """Write one self-contained HTML page: no scripts, no external resources; whole or absent.

    Raises:
        UserError: the folder cannot be written to, or the disk is full.
    """
    with whole_file(Path(path)) as aside:
        aside.write_text(render_page(title, sections), encoding="utf-8")


def render_page(title: str, sections: list[Section]) -> str:
    """The page's HTML; the same input gives the same text."""
    body = "\n".join(f"<h2>{html.escape(section.title)}</h2>\n{section.body}" for section in sections)
    heading = html.escape(title)
    return (
        f'<!doctype html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n<title>{heading}</title>\n'
        f"<style>{STYLE}</style>\n</head>\n<body>\n<h1>{heading}</h1>\n{body}\n</body>\n</html>\n"
    )


def picture(content: bytes, description: str) -> str:
    """An inline PNG with a description for readers who cannot see it."""
    data = base64.b64encode(content).decode()
    return f'<p><img alt="{html.escape(description, quote=True)}" src="data:image/png;base64,{data}"></p>'


def film(content: bytes, description: str) -> str:
    """An inline MP4 that plays without sound, over and over."""
    data = base64.b64encode(content).decode()
    label = html.escape(description, quote=True)
    source = f"data:video/mp4;base64,{data}"
    return f'<p>{label}<br><video aria-label="{label}" src="{source}" controls loop muted playsinline></video></p>'


def comparison_sections(runs: Mapping[str, RunResult], store: EpisodeStore) -> list[Section]:
    """The sections of the page, in reading order; what has nothing to show is left out."""
    reports = {name: run.report for name, run in runs.items()}
    sections = [
        Section("What was kept and dropped", _table_body(reports)),
        *_recognition_sections(_recognised(reports)),
        Section("Kept of each factor", picture(figures.kept_bars(reports), "bars of kept, state apart from noise")),
        Section("What was trained", _trained_body(runs)),
    ]
    strip = figures.frame_strip(store, rows_of(store, store.episodes("evaluation")), list(store.observations))
    drawn = {
        "What the encoder sees": strip,
        "What can be drawn again from the latent": _drawings(runs),
        "Bits in each group of codes": figures.bits_map(reports),
        "Use of the codebooks": figures.codebook_bars(reports),
        "The latents in two dimensions (PCA)": _scatter(runs, store),
        "Training": _curves(runs),
    }
    sections += [Section(name, picture(content, name)) for name, content in drawn.items() if content is not None]
    return [*sections, Section("Use the encoder", _usage_body(runs))]


def _table_body(reports: dict[str, ProbeReport]) -> str:
    lines = "<br>".join(html.escape(line) for line in notes(reports))
    return f'<div class="wide">{comparison_table(reports).html()}</div>\n<p class="note">{lines}</p>'


def _recognised(reports: Mapping[str, ProbeReport]) -> dict[str, RecognitionReport]:
    """What each classifier recognises; empty unless all were asked."""
    found = {name: report.recognition for name, report in reports.items() if report.recognition is not None}
    return found if len(found) == len(reports) else {}


def _recognition_sections(reports: dict[str, RecognitionReport]) -> list[Section]:
    if not reports:
        return []
    lines = "<br>".join(html.escape(line) for line in recognition_notes(reports))
    table = f'<div class="wide">{recognition_comparison(reports).html()}</div>\n<p class="note">{lines}</p>'
    needed = modality_bars(reports)
    bars = [] if needed is None else [picture(needed, "bars of macro F1 without each modality and with each alone")]
    matrix = picture(confusion_matrix(reports), "confusion matrix: a row a true class, a column what was recognised")
    return [Section("What is recognised", "\n".join([table, *bars, matrix]))]


def _trained_body(runs: Mapping[str, RunResult]) -> str:
    first = next(iter(runs.values())).report
    parts = [f"<p>{len(runs)} encoder(s), frozen and probed on {html.escape(first.data)}.</p>"]
    for name, run in runs.items():
        parts.append(f"<h3>{html.escape(name)}</h3>")
        facts: dict[str, Any] = {"features": run.report.features, "groups": run.report.groups}
        if run.report.codebook is not None:
            facts["codes_per_group"] = run.report.codebook.codes_per_group
        wanted = ("encoder", "bottleneck", "training", "data")
        facts |= {key: value for key, value in (run.description or {}).items() if key in wanted}
        shown = json.dumps(facts, indent=2, default=str)
        parts.append(f"<pre>{html.escape(shown)}</pre>")
    return "\n".join(parts)


def _usage_body(runs: Mapping[str, RunResult]) -> str:
    name, run = list(runs.items())[-1]
    bundle = str(run.bundle) if run.bundle is not None else name
    quantised = run.report.codebook is not None
    lines = [
        "from repdib_lightning.export import load_encoder",
        "",
        f"encoder = load_encoder({bundle!r})   # frozen, evaluation mode, no training code",
        f"latent = encoder.encode(observations)   # {{name: uint8 (N, C, H, W)}} -> float32 (N, {run.report.features})",
    ]
    if quantised:
        lines.append(f"codes = encoder.codes(observations)     # int64 (N, {run.report.groups})")
    return f"<pre>{html.escape(chr(10).join(lines))}</pre>"


def _curves(runs: Mapping[str, RunResult]) -> bytes | None:
    files = {name: run.metrics for name, run in runs.items() if run.metrics is not None}
    return curves.training_curves(files) if files else None


def _drawings(runs: Mapping[str, RunResult]) -> bytes | None:
    drawn = {name: run.drawings for name, run in runs.items() if run.drawings is not None}
    return figures.drawn_strip(drawn) if drawn else None


def _scatter(runs: Mapping[str, RunResult], store: EpisodeStore) -> bytes | None:
    """Latents coloured by the first state factor and by the noise factor that the first run kept most of."""
    encoded = {name: run.encoded for name, run in runs.items() if run.encoded is not None}
    if not encoded:
        return None
    rows = next(iter(encoded.values())).split.rows
    thin = np.unique(np.linspace(0, len(rows) - 1, min(SCATTERED, len(rows))).astype(int))
    report = next(iter(runs.values())).report
    chosen = [name for name, factor in report.factors.items() if factor.kind == "endogenous"][:1]
    noise = [name for name, factor in report.factors.items() if factor.kind == "exogenous"]
    probe = report.probes[0]
    noise.sort(key=lambda name: -(report.factors[name].probes[probe].kept or 0.0))
    chosen += noise[: 2 - len(chosen)]
    colourings = {}
    for name in chosen:
        values = store.gather(f"factors/{name}", rows[thin])
        flat = values if values.ndim == 1 else values[:, 0]
        colourings[name] = (np.asarray(flat), report.factors[name].kind)
    return figures.latent_scatter({name: part.latents[thin] for name, part in encoded.items()}, colourings)
