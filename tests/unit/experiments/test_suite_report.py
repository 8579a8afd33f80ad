"""Reports of made-up points: the numbers in the tables, what is refused, what is named as missing."""

from __future__ import annotations

import csv
import json
import re
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parent))
from finished_points import finish, made_up, typical, write_suite

from repdib_lightning.errors import UserError
from repdib_lightning.experiments import headline as headlines
from repdib_lightning.experiments import report as reports
from repdib_lightning.experiments.comparison import differences, direction, summaries
from repdib_lightning.experiments.curves import bands
from repdib_lightning.experiments.report import report_suite
from repdib_lightning.experiments.results import load_results
from repdib_lightning.experiments.suite import Claim, HeadlineRow
from repdib_lightning.experiments.suite_file import read_suite

FACTORS = {"cell": "state", "time": "noise"}


@pytest.fixture
def results(tmp_path):
    _, suite, runs = made_up(tmp_path, typical)
    return load_results(suite, suite.seeds, runs)


def row(rows, **wanted):
    (found,) = [r for r in rows if all(getattr(r, key) == value for key, value in wanted.items())]
    return found


def test_means_are_over_the_seeds_of_a_setting(results):
    found = row(summaries(results, results.suite.grids[0]), setting="vq", measure="linear/time/kept")
    assert found.n == 5
    assert found.mean.value == pytest.approx(0.22) and found.iqm.value == pytest.approx(0.22)
    assert 0.20 <= found.mean.low < 0.22 < found.mean.high <= 0.24


def test_differences_are_paired_by_seed(results):
    """Every seed moves both settings alike, so the difference has no spread at all; an unpaired one would."""
    found = row(differences(results, results.suite.grids[0]), setting="repdib", measure="linear/noise/kept")
    assert (found.difference.low, found.difference.value, found.difference.high) == pytest.approx((-0.7, -0.7, -0.7))
    assert found.ratio.value == pytest.approx(0.12 / 0.82)
    assert found.better.value == 1.0, "less noise is better, and every run keeps less"


def test_the_pairs_survive_a_missing_seed(tmp_path):
    suite = read_suite(write_suite(tmp_path))
    for point in finish(suite, tmp_path / "runs", typical):
        if (point.setting.name, point.seed) in (("none", 0), ("repdib", 4)):
            point.file.unlink()
    results = load_results(suite, suite.seeds, tmp_path / "runs")
    found = row(differences(results, suite.grids[0]), setting="repdib", measure="linear/noise/kept")
    assert found.n == 3 and found.difference.value == pytest.approx(-0.7)
    assert results.missing == ["bottleneck/none seed 0", "bottleneck/repdib seed 4"]


def test_a_run_that_two_grids_share_is_reported_in_both(results):
    shared = row(summaries(results, results.suite.grids[1]), setting="groups_8", measure="linear/time/kept")
    own = row(summaries(results, results.suite.grids[0]), setting="repdib", measure="linear/time/kept")
    assert shared.mean == own.mean
    assert len(results.records) == 4 * 5


@pytest.mark.parametrize(
    ("measure", "wanted"),
    [
        ("linear/cell/kept", "up"), ("linear/cell/error", "down"), ("linear/time/kept", "down"),
        ("linear/time/error", "up"), ("mlp/noise/kept", "down"), ("linear/state/kept", "up"),
        ("decoder/background/kept", "down"), ("decoder/background/error", "up"), ("decoder/agent/kept", "up"),
        ("decoder/picture/kept", ""), ("codes/used", ""), ("val/loss", "down"), ("val/action_accuracy", "up"),
        ("val/raw/inverse", "down"), ("val/kl_nats", ""),
        ("groups/modularity", "up"), ("groups/psnr_gain", "up"), ("groups/psnr_lost_most", ""),
        ("groups/time/moved_gap", "up"), ("groups/time/share", ""),
    ],
)  # fmt: skip
def test_which_way_is_better(measure, wanted):
    assert direction(measure, FACTORS) == wanted


def line(results, measure="linear/time", reading="kept", **paper):
    suite = replace(results.suite, headline=(HeadlineRow("x", measure, paper),))
    changed = replace(results, suite=suite)
    (found,) = [found for found in headlines.headline(changed) if found.reading == reading]
    return found


def test_the_two_readings_of_the_papers_error_point_opposite_ways(results):
    kept = line(results, reading="kept", none=1.0, vq=0.7, repdib=0.66)
    error = line(results, reading="error", none=1.0, vq=0.7, repdib=0.66)
    assert kept.cells["vq"].relative.value == pytest.approx(0.22 / 0.82)
    assert error.cells["vq"].relative.value == pytest.approx(0.78 / 0.18)
    assert kept.agrees is True and error.agrees is False


def test_settings_that_the_paper_hardly_tells_apart_have_no_order(results):
    assert line(results, none=1.0, vq=0.971, repdib=0.972).agrees is True, "repdib below vq here; the paper ties them"
    assert line(results, none=1.0, vq=0.5, repdib=0.7).agrees is False
    assert line(results, none=1.0, vq=1.001, repdib=0.999).agrees is None
    assert line(results, measure="linear/cell", reading="error", none=1.0, vq=0.5).agrees is None, "zero over zero"


@pytest.mark.parametrize(
    ("claim", "holds"),
    [
        ({"measure": "linear/noise/kept", "of": "ratio", "at_most": 0.5}, True),
        ({"measure": "linear/noise/kept", "of": "ratio", "at_most": 0.1}, False),
        ({"measure": "linear/noise/kept", "at_least": 0.115, "judge": "mean"}, True),
        ({"measure": "linear/noise/kept", "at_least": 0.115, "judge": "whole"}, False),
        ({"measure": "linear/noise/kept", "at_least": 0.125, "judge": "mean"}, False),
        ({"measure": "linear/noise/kept", "at_least": 0.125, "judge": "any"}, True),
        ({"measure": "linear/noise/kept", "at_most": 0.115, "judge": "any"}, True),
        ({"measure": "linear/noise/kept", "at_most": 0.05, "judge": "any"}, False),
        ({"measure": "linear/noise/kept", "at_least": 0.05, "judge": "interval"}, True),
        ({"measure": "linear/noise/kept", "at_least": 0.115, "judge": "interval"}, None),
        ({"measure": "linear/noise/kept", "at_most": 0.115, "judge": "interval"}, None),
        ({"measure": "linear/noise/kept", "at_most": 0.05, "judge": "interval"}, False),
        ({"measure": "linear/cell/error", "of": "difference", "at_most": 0.0, "judge": "any"}, True),
        ({"measure": "linear/cell/error", "of": "ratio", "at_most": 1.0}, None),
        ({"measure": "linear/noise/kept", "than": "vq", "of": "difference", "at_most": -0.09, "judge": "whole"}, True),
        ({"measure": "linear/noise/kept", "than": "vq", "of": "difference", "at_most": -0.11}, False),
    ],
)
def test_claims_are_held_against_mean_or_interval(results, claim, holds):
    suite = replace(results.suite, claims=(Claim("x", "repdib", **claim),))
    (found,) = headlines.verdicts(replace(results, suite=suite))
    assert found.holds is holds


def test_one_seed_gives_no_interval_and_no_verdict_on_one(tmp_path):
    suite = read_suite(write_suite(tmp_path))
    finish(suite, tmp_path / "runs", typical, seeds=(0,))
    results = load_results(suite, (0,), tmp_path / "runs")
    found = row(summaries(results, suite.grids[0]), setting="none", measure="linear/noise/kept")
    assert found.mean.low is None and found.mean.value == pytest.approx(0.8)


def test_one_seed_is_called_an_anecdote_and_gives_no_probabilities(tmp_path):
    path, _, runs = made_up(tmp_path, typical)
    report_suite(path, output=tmp_path / "a", runs=runs, seeds="3")
    text = (tmp_path / "a/report.md").read_text()
    assert "ONE SEED" in text and "NOT FINISHED" not in text
    (row,) = re.findall(r"\| linear/noise/kept ↓ \| -0.600 (.*)", text)
    assert row == "| - | -0.700 | - |"
    report_suite(path, output=tmp_path / "b", runs=runs, seeds="3,4")
    assert "ONE SEED" not in (tmp_path / "b/report.md").read_text()


def test_bands_are_over_seeds_at_the_steps_that_all_logged(results):
    path = results.points["bottleneck/vq", 0].folder / "metrics.csv"
    path.write_text("\n".join(path.read_text().splitlines()[:-1]) + "\n")
    band = bands(results, results.suite.grids[0])["train/raw/inverse"]["vq"]
    assert band.steps.tolist() == [9, 19] and band.seeds == 5
    assert band.mean == pytest.approx([1.53, 1.43])
    assert np.all(band.low < band.mean) and np.all(band.mean < band.high)


def files(folder):
    return {path.name: path.read_bytes() for path in folder.iterdir()}


def test_the_report_is_whole_repeatable_and_needs_no_network(tmp_path, monkeypatch):
    path, _suite, runs = made_up(tmp_path, typical)
    shown = report_suite(path, output=tmp_path / "a", runs=runs)
    report_suite(path, output=tmp_path / "b", runs=runs)
    first = files(tmp_path / "a")
    assert first == files(tmp_path / "b")
    wanted = {"report.md", "report.html", "summary.csv", "differences.csv", "curves.csv", "points.jsonl"}
    assert wanted <= set(first) and "time: how much of it is kept" in shown
    page, text = first["report.html"].decode(), first["report.md"].decode()
    sources = re.findall(r'(?:src|href)="([^"]*)"', page)
    assert sources and all(source.startswith("data:image/png;base64,") for source in sources)
    assert "http" not in page and "<script" not in page
    assert set(re.findall(r"\]\(([^)]*)\)", text)) == {name for name in first if name.endswith(".png")}
    assert "0.268" in text, "0.22 / 0.82"
    points = [json.loads(line) for line in first["points.jsonl"].decode().splitlines()]
    assert len(points) == 20 and all(p["configuration"] and p["metrics"] and p["versions"] for p in points)
    table = list(csv.DictReader(first["summary.csv"].decode().splitlines()))
    assert {r["setting"] for r in table} == {"none", "vq", "repdib", "groups_4", "groups_8"}


def test_what_is_not_finished_is_named_and_left_out(tmp_path):
    path, _suite, runs = made_up(tmp_path, typical)
    (runs / "made_up/bottleneck/vq/seed_3.json").unlink()
    shown = report_suite(path, output=tmp_path / "a", runs=runs)
    assert "bottleneck/vq seed 3" in shown
    assert "NOT FINISHED, and left out: bottleneck/vq seed 3" in (tmp_path / "a/report.md").read_text()
    assert "vq (n=4)" in (tmp_path / "a/report.md").read_text()


def test_development_seeds_do_not_reach_the_results_by_themselves(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    path = write_suite(tmp_path)
    finish(read_suite(path), tmp_path / "runs", typical, seeds=(100, 101, 102))
    with pytest.raises(UserError, match="no point is finished"):
        report_suite(path, runs=tmp_path / "runs")
    report_suite(path, runs=tmp_path / "runs", tune=True)
    assert not Path("results").exists() and (tmp_path / "runs/made_up/report/report.md").is_file()
    with pytest.raises(UserError, match="seed 100 is for development"):
        report_suite(path, runs=tmp_path / "runs", seeds="0,100")


def test_runs_on_other_data_are_not_compared(tmp_path):
    path, _suite, runs = made_up(tmp_path, typical)
    file = runs / "made_up/bottleneck/vq/seed_3.json"
    file.write_text(file.read_text().replace('"fingerprint": "abc"', '"fingerprint": "other"'))
    with pytest.raises(UserError, match=r"vq/seed_3: was trained on other data than .*none/seed_0"):
        report_suite(path, output=tmp_path / "a", runs=runs)
    assert not (tmp_path / "a").exists()


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("[val/raw/inverse]", "[val/raw/inverze]", "measures: no point has 'val/raw/inverze', did you mean"),
        ("measure: linear/time", "measure: linear/tine", "headline.time: no point has the measure 'linear/tine/error'"),
        ("colours: [cell, time]", "colours: [cell, tine]", "colours: no factor is called 'tine', did you mean 'time'"),
        ("claims: {}", "claims: {it works: {setting: vq, measure: linear/noice/kept, at_most: 1}}", "claims.it works"),
    ],
)
def test_measures_that_no_point_has_are_refused_by_name(tmp_path, old, new, said):
    _, _suite, runs = made_up(tmp_path, typical)
    path = write_suite(tmp_path, **{old: new})
    with pytest.raises(UserError) as caught:
        report_suite(path, output=tmp_path / "a", runs=runs)
    assert said in str(caught.value) and str(path) in str(caught.value)
    assert not (tmp_path / "a").exists()


def test_claims_without_a_papers_table_stand_alone(tmp_path):
    claims = "claims: {less noise: {setting: vq, measure: linear/noise/kept, of: ratio, at_most: 0.5}}"
    paper = "  time:\n    measure: linear/time\n    paper: {none: 1.0, vq: 0.70, repdib: 0.66}\n"
    _, _, runs = made_up(tmp_path, typical)
    path = write_suite(tmp_path, **{"claims: {}": claims, f"headline:\n{paper}": ""})
    report_suite(path, output=tmp_path / "a", runs=runs)
    text = (tmp_path / "a/report.md").read_text()
    assert "## Claims" in text and "| less noise |" in text and "paper" not in text.lower()


def test_a_baseline_that_nothing_was_kept_of_gives_no_ratio(tmp_path):
    path, _suite, runs = made_up(tmp_path, lambda s, n: {**typical(s, n), "linear/time/kept": 0.0})
    report_suite(path, output=tmp_path / "a", runs=runs)
    assert "| time: how much of it is kept | - | - | - | - |" in (tmp_path / "a/report.md").read_text()


def test_the_first_probe_is_shown_and_the_others_are_in_the_csv(results):
    shown = reports.table_measures(results, results.suite.grids[0])
    assert "mlp/time/kept" not in shown and "linear/time/kept" in shown
    assert "mlp/time/kept" in {r.measure for r in summaries(results, results.suite.grids[0])}
