"""``suite report``: tables, figures and one page of a suite's finished points."""

from __future__ import annotations

import html
import json
from collections.abc import Sequence
from pathlib import Path

from repdib_lightning.data.files import whole_file
from repdib_lightning.data.outputs import check_output_file
from repdib_lightning.errors import UserError, nearest
from repdib_lightning.evaluation import figures as probe_figures
from repdib_lightning.evaluation.report import Section, write_report
from repdib_lightning.evaluation.samples import ProbeSamples, read_samples
from repdib_lightning.experiments import figures, tables
from repdib_lightning.experiments.against import against_parts
from repdib_lightning.experiments.comparison import Difference, Summary, differences, summaries
from repdib_lightning.experiments.curve_names import check_curves
from repdib_lightning.experiments.curves import Band, bands, finetune_bands, write_bands
from repdib_lightning.experiments.exploration_part import exploration_parts
from repdib_lightning.experiments.film_part import film_parts
from repdib_lightning.experiments.finetune_parts import finetune_parts, training_only
from repdib_lightning.experiments.group_part import group_parts
from repdib_lightning.experiments.headline import WHOLE, HeadlineLine, headline, verdicts
from repdib_lightning.experiments.maze_maps import Maps, mean_maps, write_maps
from repdib_lightning.experiments.overview import overview_parts
from repdib_lightning.experiments.page import Part, as_markdown, as_section, facts_of
from repdib_lightning.experiments.points import PROBE_FILE, SAMPLES_FILE
from repdib_lightning.experiments.recognition_part import recognition_parts
from repdib_lightning.experiments.results import Results, load_results
from repdib_lightning.experiments.run import RUNS, chosen_points
from repdib_lightning.experiments.suite import Grid
from repdib_lightning.experiments.suite_file import read_suite
from repdib_lightning.experiments.suite_measures import RECOGNITION_PROBE
from repdib_lightning.rl import AGENTS

RESULTS = Path("results")
Numbers = dict[str, tuple[list[Summary], list[Difference]]]
"""Grid -> all its summaries and differences."""


def report_suite(
    suite: Path, *, output: Path | None = None, tune: bool = False, seeds: str = "", runs: Path = RUNS
) -> str:
    """Report every finished point of a suite: Markdown, one HTML page, CSV, PNG figures, and a JSON line a point.

    Args:
        suite: a YAML file, or the name of a packaged suite.
        output: folder to write; results/NAME by default, and the runs' folder for development seeds.
        tune: report the development seeds, which never go into results/ by themselves.
        seeds: other seeds than the suite's, between commas.
        runs: folder of all suites' runs.

    Raises:
        UserError: a bad suite or option, or no finished point; nothing is written then.
    """
    plan = read_suite(suite)
    points = chosen_points(plan, tune=tune, seeds=seeds, only="", runs=runs)
    results = load_results(plan, dict.fromkeys(point.seed for point in points), runs)
    folder = output or (runs / plan.name / "report" if tune else RESULTS / plan.name)
    check_output_file(folder / "report.html", "--output", ".html")
    check_curves(results)
    all_bands = {grid.name: bands(results, grid) | finetune_bands(results, grid) for grid in plan.grids}
    all_maps = {grid.name: mean_maps(results, grid) for grid in plan.grids}
    found = {grid.name: (summaries(results, grid), differences(results, grid)) for grid in plan.grids}
    parts = [*_headline_part(results), *_grid_parts(results, found, all_bands, all_maps), *_latent_parts(results)]
    parts = [*overview_parts(results), *parts, *against_parts(results)]
    parts += [*group_parts(results), *recognition_parts(results), *film_parts(results)]
    _write(folder, results, parts, all_bands)
    if any(all_maps.values()):
        write_maps(folder / "maps.json", all_maps)
    tables.write_summaries(folder / "summary.csv", [row for rows, _ in found.values() for row in rows])
    tables.write_differences(folder / "differences.csv", [row for _, rows in found.values() for row in rows])
    missing = f"    {len(results.missing)} not finished: {', '.join(results.missing[:4])}" if results.missing else ""
    shown = "\n\n".join(table.text() for table in next(part.tables for part in parts if part.tables))
    return f"{shown}\n\nwrote {folder}/report.md, report.html and the rest, of {len(results.records)} points{missing}"


def _headline_part(results: Results) -> list[Part]:
    suite = results.suite
    lines, found = headline(results), verdicts(results)
    shown = tables.headline_tables(results, lines)
    if found:
        shown.append(tables.claims_table(found, suite))
    if not shown:
        return []
    if not lines:
        return [Part("Claims", [], shown, {})]
    return [Part("The paper's table, and ours", _headline_sentences(lines, suite.grids[0]), shown, {})]


def _headline_sentences(lines: Sequence[HeadlineLine], grid: Grid) -> list[str]:
    whole = ["The paper's numbers are of its own data: their order can be compared with ours, not their size."]
    relative = [
        f"Relative to '{grid.baseline}': mean over mean, seeds in pairs, with a 95 % bootstrap interval over seeds.",
        'The paper prints a relative "error" and does not define it. Two readings: the error of a probe that predicts '
        "the factor (1 - R2; 1 - accuracy; the squared error of drawn pixels over that of the mean picture), which is "
        "high where noise was dropped; and how much of it is kept, (score - chance) / (1 - chance), then low.",
    ]
    return [
        *(whole if any(line.reading == WHOLE for line in lines) else []),
        *(relative if any(line.reading != WHOLE for line in lines) else []),
        "Paper's order: whether any two settings that the paper tells apart, by 0.01 or more, come in the same order.",
    ]


def _grid_parts(
    results: Results, found: Numbers, all_bands: dict[str, dict[str, dict[str, Band]]], all_maps: dict[str, Maps]
) -> list[Part]:
    parts = []
    for grid in results.suite.grids:
        measures = table_measures(results, grid)
        shown = [
            tables.summary_table(results, grid, found[grid.name][0], measures),
            tables.difference_table(results, grid, found[grid.name][1], measures),
        ]
        drawn = _known(f"{grid.name}-seeds", figures.seed_points(results, grid, _drawn_measures(measures)))
        drawn |= _known(f"{grid.name}-curves", figures.curves_with_bands(grid, training_only(all_bands[grid.name])))
        drawn |= _known(f"{grid.name}-codebooks", _codebooks(results, grid))
        sentences = [grid.about] if grid.about else []
        sentences.append(
            "↑ more is better, ↓ less is better. P: probability that a run is better than one of the baseline."
        )
        parts.append(Part(f"Grid: {grid.name}", sentences, shown, drawn))
        explored = exploration_parts(results, grid, all_bands[grid.name])
        parts += explored or finetune_parts(grid, all_bands[grid.name], all_maps[grid.name])
    return parts


def table_measures(results: Results, grid: Grid) -> list[str]:
    """What the tables show: kept of all factors (first probe) and of the pictures, codes, and what the suite names."""
    known = results.measures(grid)
    anywhere = dict.fromkeys(name for each in results.suite.grids for name in results.measures(each))
    first = known[0].partition("/")[0] if known else ""
    first = next((name.partition("/")[0] for name in known if name.endswith("/kept")), first)
    kept = [name for name in known if name.endswith("/kept") and name.partition("/")[0] in (first, "decoder")]
    means = [name for name in kept if name.split("/")[1] in ("state", "noise")]
    for name in results.suite.measures:
        if name not in anywhere:
            raise UserError(f"{results.suite.file}: measures: no point has '{name}', {nearest(name, anywhere)}")
    chosen = [name for name in results.suite.measures if name in known]
    codes = [name for name in known if name.startswith("codes/")]
    return [*means, *[name for name in kept if name not in means], *chosen, *codes]


def _drawn_measures(measures: Sequence[str]) -> list[str]:
    """Kept, reached by fine-tuning, recognised, and codes in use."""
    reached = [name for name in measures if name.partition("/")[0] in AGENTS]
    reached += [name for name in measures if name.startswith(f"{RECOGNITION_PROBE}/") and name.count("/") == 1]
    codes = [name for name in measures if name.startswith("codes/used")]
    return [name for name in measures if name.endswith("/kept")] + reached + codes


def _codebooks(results: Results, grid: Grid) -> bytes | None:
    uses: dict[str, list[dict[str, list[float]]]] = {}
    codes = 0
    for setting in grid.settings:
        for seed in results.seeds if setting.pretrained else ():
            point = results.point(setting, seed)
            use = json.loads((point.folder / PROBE_FILE).read_text())["codebook"] if point else None
            if use is not None:
                uses.setdefault(setting.name, []).append(use)
                codes = max(codes, use["codes_per_group"])
    return figures.codebook_use(uses, codes)


def _latent_parts(results: Results) -> list[Part]:
    """Latents and drawn pictures of the settings to show, of the first seed that all of them have."""
    grid = results.suite.grids[0]
    shown = [setting for setting in grid.settings if setting.name in results.suite.show]
    shared = [seed for seed in results.seeds if all(results.point(setting, seed) for setting in shown)]
    if not shown or not shared:
        return []
    samples: dict[str, ProbeSamples] = {}
    for setting in shown:
        point = results.point(setting, shared[0])
        assert point is not None
        samples[setting.name] = read_samples(point.folder / SAMPLES_FILE)
    colours = {}
    for factor in results.suite.colours:
        if factor not in results.factors:
            raise UserError(
                f"{results.suite.file}: colours: no factor is called '{factor}', "
                f"{nearest(factor, results.factors) or 'the data have none'}"
            )
        colours[factor] = results.factors[factor]
    drawings = {name: part.drawings for name, part in samples.items() if part.drawings is not None}
    drawn = {"latents": figures.latent_maps(samples, colours)} if colours else {}
    drawn |= {"drawn": probe_figures.drawn_strip(drawings)} if drawings else {}
    title = f"What the latents look like (seed {shared[0]})"
    return [Part(title, ["t-SNE of held-out latents."], [], drawn)] if drawn else []


def _known(name: str, content: bytes | None) -> dict[str, bytes]:
    return {} if content is None else {name: content}


def _write(
    folder: Path, results: Results, parts: Sequence[Part], all_bands: dict[str, dict[str, dict[str, Band]]]
) -> None:
    suite = results.suite
    lines = [results.records[key].line() for key in results.records]
    _write_text(folder / "points.jsonl", "\n".join(lines) + "\n")
    write_bands(folder / "curves.csv", all_bands)
    for part in parts:
        for name, content in part.figures.items():
            with whole_file(folder / f"{name}.png") as aside:
                aside.write_bytes(content)
        for name, content in part.films.items():
            with whole_file(folder / f"{name}.mp4") as aside:
                aside.write_bytes(content)
    facts = facts_of(results)
    _write_text(folder / "report.md", as_markdown(suite.title, facts, parts))
    about = Section("What was run", f"<p>{'<br>'.join(html.escape(line) for line in facts)}</p>")
    write_report(folder / "report.html", suite.title, [about, *[as_section(part) for part in parts]])


def _write_text(path: Path, text: str) -> None:
    with whole_file(path) as aside:
        aside.write_text(text)
