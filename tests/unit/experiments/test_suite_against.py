"""Measures against a number that settings vary, and points that are probed on a store of their own."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from finished_points import finish, typical, write_suite

from repdib_lightning.errors import UserError
from repdib_lightning.experiments import against
from repdib_lightning.experiments.page import facts_of
from repdib_lightning.experiments.report import report_suite
from repdib_lightning.experiments.results import load_results
from repdib_lightning.experiments.suite_file import read_suite

OPTION = "model.bottleneck.init_args.groups"
ENTRY = f"against: {{g: {{grid: groups, option: {OPTION}, measures: [linear/cell/kept, linear/time/kept]}}}}\n"


def suite_with(folder, entry=ENTRY, **replaced):
    path = write_suite(folder, **replaced)
    path.write_text(path.read_text() + entry)
    return path


def test_the_numbers_of_a_grid_are_those_of_its_settings(tmp_path):
    suite = read_suite(suite_with(tmp_path))
    assert suite.grid("groups").numbers(OPTION) == {"groups_4": 4.0, "groups_8": 8.0}
    assert suite.grid("bottleneck").numbers(OPTION) == {"vq": 8.0, "repdib": 8.0}, "none has no groups"
    assert suite.grid("groups").numbers("model.bottleneck.class_path") == {}, "a word is no number"


def test_a_panel_has_the_mean_of_every_number_in_order_and_a_line_for_what_has_none(tmp_path, monkeypatch):
    more = "  mixed:\n    settings:\n      none: {config: bottleneck/none}\n"
    for count in (8, 4):
        more += f"      g{count}: {{config: bottleneck/repdib, {OPTION}: {count}}}\n"
    path = suite_with(tmp_path, ENTRY.replace("grid: groups", "grid: mixed"), **{"headline:\n": more + "headline:\n"})
    suite, runs = read_suite(path), tmp_path / "runs"
    finish(suite, runs, lambda setting, seed: {**typical(setting, seed), "linear/cell/kept": len(setting) + 0.1 * seed})
    results, drawn = load_results(suite, suite.seeds, runs), []
    monkeypatch.setattr(against, "png", lambda figure: drawn.append(figure) or b"")
    against.against_parts(results)
    panel = drawn[0].axes[0]
    assert [label.get_text() for label in panel.get_xticklabels()] == ["4", "8"]
    lines = {line.get_label(): line for line in panel.get_lines()}
    # g8 is the run that the grid "groups" calls groups_8, repdib that of grid "bottleneck"
    assert lines["mean"].get_ydata() == pytest.approx([8.2, 6.2])
    assert lines["none (n=5)"].get_ydata() == pytest.approx([4.2, 4.2])
    assert len(drawn[0].axes) == 2


def test_the_report_has_the_figure_and_says_what_the_lines_are(tmp_path):
    path = suite_with(tmp_path)
    finish(read_suite(path), tmp_path / "runs", typical)
    report_suite(path, output=tmp_path / "out", runs=tmp_path / "runs")
    assert (tmp_path / "out/against-g.png").is_file()
    assert "against-g.png" in (tmp_path / "out/report.md").read_text()


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (("grid: groups", "grid: grops"), r"against\.g\.grid: 'grops' is not known, did you mean 'groups'"),
        (("option: ", "options: "), r"unknown key 'against\.g\.options', did you mean 'option'"),
        ((f", option: {OPTION}", ""), r"against\.g\.option is missing"),
        (
            (OPTION, "model.shift"),
            r"against\.g\.option: no two settings of 'groups' have different numbers",
        ),
        (("linear/time/kept", "linaer/time/kept"), r"against\.g\.measures: .*'linaer' is no probe or agent here, did"),
        (("[linear/cell/kept, linear/time/kept]", "3"), r"against\.g\.measures must be a list of words"),
        (("{g: ", "{g/h: "), r"'g/h' cannot name a folder"),
    ],
)
def test_a_mistake_names_file_and_key(tmp_path, change, said):
    with pytest.raises(UserError, match=r"made_up\.yaml: .*" + said):
        read_suite(suite_with(tmp_path, ENTRY.replace(*change)))


def probed(point, fingerprint):
    record = json.loads(point.file.read_text())
    record["probed"] = {"file": "q.h5", "fingerprint": fingerprint}
    point.file.write_text(json.dumps(record) + "\n")


def test_points_of_one_probe_store_must_have_been_probed_on_the_same_data(tmp_path):
    suite = read_suite(suite_with(tmp_path, "probe_data: data/q.h5\n"))
    points = finish(suite, tmp_path / "runs", typical)
    for point in points:
        probed(point, "q1")
    facts = " ".join(facts_of(load_results(suite, suite.seeds, tmp_path / "runs")))
    assert "on x.h5 (fingerprint abc), probed on q.h5 (fingerprint q1)," in facts
    probed(points[3], "q2")
    with pytest.raises(UserError, match=rf"{Path(points[3].folder).name}: was probed on other data"):
        load_results(suite, suite.seeds, tmp_path / "runs")
