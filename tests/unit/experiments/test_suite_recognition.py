"""Suites of classifiers: what is measured, held beside a paper's printed numbers, and drawn."""

import csv
import json
import re
import sys
from dataclasses import replace
from pathlib import Path

import pytest
import yaml

sys.path.insert(0, str(Path(__file__).parent))
from finished_points import finish

from repdib_lightning.errors import UserError
from repdib_lightning.evaluation.recognition import RecognitionReport, Scores
from repdib_lightning.experiments import headline as headlines
from repdib_lightning.experiments import recognition_part
from repdib_lightning.experiments import report as reports
from repdib_lightning.experiments.comparison import direction
from repdib_lightning.experiments.measures import collect_measures
from repdib_lightning.experiments.report import report_suite
from repdib_lightning.experiments.results import load_results
from repdib_lightning.experiments.suite import HeadlineRow
from repdib_lightning.experiments.suite_file import read_suite
from repdib_lightning.experiments.tables import whole_table

SUITE = {
    "title": "Recognition",
    "base": "robot_arm",
    "data": "data/clips.h5",
    "probe": {"probes": "linear,recognition"},
    "grids": {
        "people": {"settings": {"none": {"config": "bottleneck/none"}, "fused": {"config": "bottleneck/vq"}}},
        "days": {"data": "data/days.h5", "settings": {"none": {"config": "bottleneck/none"}, "both": {}}},
    },
    "headline": {
        "F1, people": {"measure": "recognition/f1_macro", "paper": {"none": 0.6935, "fused": 0.5747}},
        "F1, days": {"measure": "recognition/f1_macro", "grid": "days", "paper": {"none": 0.8389, "both": 0.8496}},
    },
    "measures": ["recognition/f1_macro", "recognition/without/cam1"],
    "curves": [],
}
F1 = {"none": 0.8, "fused": 0.7, "both": 0.75}


def write(folder, **changed):
    path = folder / "recognition.yaml"
    path.write_text(yaml.safe_dump({**SUITE, **changed}, sort_keys=False))
    return path


def numbers(setting, seed):
    f1 = F1[setting] + 0.01 * seed
    return {
        "val/loss": 1.0,
        "linear/time/kept": 0.5,
        "recognition/f1_macro": f1,
        "recognition/without/cam1": f1 - 0.1,
        "recognition/weight/cam1": 0.25,
    }


def finished(folder, **changed):
    path = write(folder, **changed)
    finish(read_suite(path), folder / "runs", numbers)
    return path


def lines_of(folder, **changed):
    suite = read_suite(finished(folder, **changed))
    results = load_results(suite, suite.seeds, folder / "runs")
    return results, headlines.headline(results)


# what is measured


def test_the_record_of_the_probe_becomes_measures_by_name(tmp_path):
    scores = Scores(0.5, 0.6, 0.7, 0.6)
    report = RecognitionReport(
        target="activity",
        classes=["walking", "sitting"],
        clips=4,
        scores=scores,
        f1={"walking": 0.5, "sitting": None},
        confusion=[[2, 0], [2, 0]],
        without={"cam1": replace(scores, f1_macro=0.3), "gyroscope": replace(scores, f1_macro=0.4)},
        only={"cam1": 0.2},
        attention={"cam1": 0.75},
        perplexity={"cam1": 12.0, "fused": 30.0},
    )
    record = {"factors": {}, "summary": {}, "codebook": None, "recognition": report.to_dict()}
    record |= {"data": "a.h5", "fingerprint": "f"}
    (tmp_path / "probe.json").write_text(json.dumps(record))
    (tmp_path / "config.yaml").write_text("{}")
    (tmp_path / "environment.json").write_text('{"versions": {}, "data": {"fingerprint": "f"}}')
    (tmp_path / "metrics.csv").write_text("epoch,step,val/loss\n0,9,1.0\n")
    found = collect_measures(tmp_path, tmp_path / "probe.json").metrics
    assert found == {
        "val/loss": 1.0,
        "recognition/f1_macro": 0.5,
        "recognition/f1_micro": 0.6,
        "recognition/f1_weighted": 0.7,
        "recognition/accuracy": 0.6,
        "recognition/f1/walking": 0.5,
        "recognition/without/cam1": 0.3,
        "recognition/without/gyroscope": 0.4,
        "recognition/only/cam1": 0.2,
        "recognition/weight/cam1": 0.75,
        "recognition/perplexity/cam1": 12.0,
        "recognition/perplexity/fused": 30.0,
    }


@pytest.mark.parametrize(
    ("measure", "wanted"),
    [
        *(
            (f"recognition/{name}", "up")
            for name in ("f1_macro", "accuracy", "f1/walking", "without/cam1", "only/cam1")
        ),
        *((f"recognition/{name}", "") for name in ("weight/cam1", "perplexity/fused")),
        *(("val/f1_macro", "up"), ("val/raw/classification", "down")),
    ],
)
def test_which_way_is_better(measure, wanted):
    assert direction(measure, {}) == wanted


# mistakes in the file


@pytest.mark.parametrize(
    ("changed", "said"),
    [
        ({"probe": {"probes": "recognition"}}, r"probe\.probes: one of linear, mlp is needed"),
        ({"probe": {"probes": "linear,recogniton"}}, r"'recogniton' is not known, did you mean 'recognition'"),
        ({"measures": ["recognition/f1_makro"]}, r"'f1_makro' is not measured, did you mean 'f1_macro'"),
        ({"measures": ["recognition/witout/cam1"]}, r"'witout' of a class or modality is not measured.*'without'"),
        ({"probe": {"probes": "linear"}, "headline": {}}, r"'recognition' is no probe or agent here"),
        ({"recognised": ["people/nne"]}, r"recognised: 'people/nne' is not known, did you mean 'people/none'"),
        (
            {"headline": {"a": {"measure": "recognition/f1_macro", "grid": "dayz"}}},
            r"headline\.a\.grid: 'dayz' is not known, did you mean 'days'",
        ),
        (
            {"headline": {"a": {"measure": "recognition/f1_macro", "paper": {"both": 1}}}},
            r"headline\.a\.paper: 'both' is not known",
        ),
        (
            {"headline": {"a": {"measure": "linear/time", "grid": "days"}}},
            r"headline\.a\.grid: 'linear/time' is read relative .* such as linear/time/kept",
        ),
    ],
)
def test_every_mistake_is_one_line_that_names_the_file_and_the_key(tmp_path, changed, said):
    path = write(tmp_path, **changed)
    with pytest.raises(UserError, match=said) as error:
        read_suite(path)
    assert str(error.value).startswith(f"{path}: ") and "\n" not in str(error.value)


# beside the paper


def test_a_whole_measure_stands_beside_the_papers_number_as_it_is(tmp_path):
    results, lines = lines_of(tmp_path)
    assert [(line.row.label, line.reading) for line in lines] == [("F1, people", ""), ("F1, days", "")]
    assert lines[0].cells["fused"].absolute.value == pytest.approx(0.72)
    assert lines[1].cells["both"].absolute.value == pytest.approx(0.77)
    assert [line.agrees for line in lines] == [True, False]
    table = whole_table(results, lines)
    assert table.header == ["", "none", "fused", "both", "paper's order"]
    assert table.rows[0] == ["F1, people: paper", "0.6935", "0.5747", "-", ""]
    assert table.rows[1][0] == "F1, people: here" and table.rows[1][1].startswith("0.820 [0.8")
    assert table.rows[1][3] == "-" and table.rows[1][4] == "yes" and table.rows[3][4] == "no"


def test_a_whole_measure_of_a_factor_is_not_read_twice(tmp_path):
    row = HeadlineRow("x", "linear/time/kept", {"none": 1.0})
    results, _ = lines_of(tmp_path)
    lines = headlines.headline(replace(results, suite=replace(results.suite, headline=(row,))))
    assert [line.cells["none"].absolute.value for line in lines] == [pytest.approx(0.5)]


def test_relative_and_whole_rows_stand_in_tables_of_their_own(tmp_path):
    both = {**SUITE["headline"], "time": {"measure": "linear/time/kept"}, "noise": {"measure": "linear/cell"}}
    path = write(tmp_path, headline=both)
    cell = {"linear/cell/kept": 0.5, "linear/cell/error": 0.5}
    finish(read_suite(path), tmp_path / "runs", lambda s, n: {**numbers(s, n), **cell})
    report_suite(path, output=tmp_path / "a", runs=tmp_path / "runs")
    text = (tmp_path / "a/report.md").read_text()
    assert "their order can be compared with ours" in text and "Two readings" in text
    assert text.index("| F1, people: here |") < text.index("| noise: how much of it is kept |")
    assert "| time: here | 0.500" in text


def test_a_report_without_relative_rows_says_nothing_of_two_readings(tmp_path):
    path = finished(tmp_path)
    report_suite(path, output=tmp_path / "a", runs=tmp_path / "runs")
    text = (tmp_path / "a/report.md").read_text()
    assert "their order can be compared with ours" in text and "readings" not in text
    assert re.search(r"\| recognition/without/cam1 ↑ \| 0\.720", text)
    table = list(csv.DictReader((tmp_path / "a/summary.csv").open()))
    assert {row["measure"] for row in table} >= {"recognition/f1_macro", "recognition/weight/cam1"}


# the packaged suite


def test_what_the_packaged_suite_compares_differs_in_one_thing():
    suite = read_suite("activities")
    for grid in suite.grids:
        merged = {setting.name: setting.merged for setting in grid.settings}
        for base in ("hamlet", "keyless"):
            plain, fused, both = merged[base], merged[f"{base}_fusion"], merged[f"{base}_both"]
            assert plain["model"]["bottleneck"]["class_path"] == "Identity"
            assert fused["model"]["bottleneck"]["class_path"] == "RepDIB"
            assert {**fused["model"], "bottleneck": None} == {**plain["model"], "bottleneck": None}
            inside = both["model"]["encoder"]["init_args"]
            assert inside["bottleneck"] == "RepDIB" and both["model"]["bottleneck"] == fused["model"]["bottleneck"]
            kept = {name: value for name, value in inside.items() if not name.startswith("bottleneck")}
            assert kept == plain["model"]["encoder"]["init_args"] and both["data"] == fused["data"] == plain["data"]
        other = {**merged["hamlet"]["model"]["encoder"]["init_args"], "pooling": "keyless", "fusion": "keyless"}
        assert merged["keyless"]["model"]["encoder"]["init_args"] == other


# pictures


def test_every_seed_is_drawn_of_the_scores_only(tmp_path, monkeypatch):
    asked = []
    monkeypatch.setattr(reports.figures, "seed_points", lambda results, grid, measures: asked.append(measures))
    report_suite(finished(tmp_path), output=tmp_path / "a", runs=tmp_path / "runs")
    assert asked == [["linear/time/kept", "recognition/f1_macro"]] * 2


def test_the_named_settings_are_drawn_from_their_first_finished_seed(tmp_path, monkeypatch):
    asked = []

    def draw(bundle, data, name, **_options):
        asked.append((bundle, data, name))
        return {figure: b"\x89PNG\r\n\x1a\n" + figure.encode() for figure in ("confusion", "modalities")}, "a line"

    monkeypatch.setattr(recognition_part, "recognition_figures", draw)
    path = finished(tmp_path, recognised=["days/both"])
    (tmp_path / "runs/recognition/days/both/seed_0.json").unlink()
    report_suite(path, output=tmp_path / "a", runs=tmp_path / "runs")
    bundle = tmp_path / "runs/recognition/days/both/seed_1/bundle"
    assert asked == [(bundle, Path("data/days.h5"), "days/both, seed 1")]
    drawn = sorted(file.name for file in (tmp_path / "a").glob("recognised-*"))
    assert drawn == ["recognised-days-both-confusion.png", "recognised-days-both-modalities.png"]
    assert (tmp_path / "a" / drawn[0]).read_bytes().endswith(b"confusion")
    text = (tmp_path / "a/report.md").read_text()
    assert "## What is recognised" in text and all(f"({name})" in text for name in drawn)
