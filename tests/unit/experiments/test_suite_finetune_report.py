"""Reports of made-up fine-tunings: their measures, learning curves, and maps of mazes."""

from __future__ import annotations

import csv
import json
import sys
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parent))
from finished_points import finish, typical

from repdib_lightning.errors import UserError
from repdib_lightning.experiments import headline, maze_maps
from repdib_lightning.experiments import report as reports
from repdib_lightning.experiments.comparison import direction
from repdib_lightning.experiments.curve_names import check_curves
from repdib_lightning.experiments.curves import Band, bands, finetune_bands, read_bands, write_bands
from repdib_lightning.experiments.figures import learning_curves_figure
from repdib_lightning.experiments.maze_maps import MeanMaps, coverage_figure, mean_maps, read_maps, topology_figure
from repdib_lightning.experiments.report import report_suite
from repdib_lightning.experiments.results import load_results
from repdib_lightning.experiments.suite_file import read_suite

SUITE = """
base: [robot_arm]
data: data/x.h5
seeds: [0, 1]
finetune:
  agent: dqn
  runs:
    Spiral: {env: SpiralWorld}
    Free: {env: LoopWorld, env_options.goals: none}
    Arm: {env: RobotArm}
grids:
  clean:
    baseline: none
    settings:
      none: {config: bottleneck/none}
      vq: {config: bottleneck/vq}
      scratch: {pretrained: false}
  noisy:
    data: data/noisy.h5
    finetune: {runs: {Spiral: {env: SpiralWorld, steps: 300}}}
    settings:
      none: {config: bottleneck/none}
      vq: {config: bottleneck/vq}
claims:
  first: {setting: scratch, measure: dqn/Spiral/success, at_least: 0.0}
  second: {grid: noisy, setting: vq, measure: dqn/Spiral/success, of: difference, at_least: 0.19}
measures: [dqn/Spiral/success, dqn/Free/coverage]
show: [none]
colours: [cell]
"""
BEST = {"none": 0.2, "vq": 0.4, "scratch": 0.1}


def outcome(name: str, environment: str, setting: str, seed: int) -> dict:
    """Success of a setting, more with each seed; visits of one cell twice as many as of the seed-th."""
    measures = {"success": BEST[setting] + seed / 10, "topology": 0.5 + seed / 10, "coverage": 1.0}
    visits = np.ones((6, 6))
    visits[0, seed] = 5
    distance = np.arange(36.0).reshape(6, 6) * (1 + seed)
    maps = {"visits": visits.tolist(), "latent_distance": distance.tolist(), "path_length": visits.tolist()}
    if name == "Free":
        del measures["success"]
    return {"agent": "dqn", "environment": environment, "versions": {}, "configuration": {}, "measures": measures,
            "maps": {} if environment == "RobotArm" else maps}  # fmt: skip


def finetuned(setting: str, seed: int) -> dict[str, float]:
    found = {} if setting == "scratch" else typical(setting, seed)
    return {**found, "dqn/Spiral/success": BEST[setting] + seed / 10, "dqn/Free/coverage": 1.0}


@pytest.fixture
def made(tmp_path):
    """A suite's file and the folder of its runs, all points finished."""
    path = tmp_path / "mazes.yaml"
    path.write_text(SUITE)
    suite = read_suite(path)
    for point in finish(suite, tmp_path / "runs", finetuned):
        record = point.record()
        if not point.setting.pretrained:
            record.data, record.factors = {}, {}
        elif point.setting.grid == "noisy":
            record.data = {"file": "noisy.h5", "fingerprint": "other"}
        if point.setting.grid == "noisy":
            record.metrics.pop("dqn/Free/coverage")
        point.write(record)
        for name, options in point.setting.finetune.runs.items():
            folder = point.finetune_folder(name)
            folder.mkdir(parents=True)
            content = outcome(name, options["env"], point.setting.name, point.seed)
            (folder / "outcome.json").write_text(json.dumps(content))
            column = "train/coverage" if name == "Free" else "eval/success"
            rows = [f"{step},{BEST[point.setting.name] * step / 200 + point.seed / 10}" for step in (100, 200)]
            (folder / "progress.csv").write_text("\n".join([f"step,{column}", *rows]) + "\n")
    for point in (p for p in (tmp_path / "runs/mazes/clean/scratch").glob("seed_?") if p.is_dir()):
        for name in ("metrics.csv", "probe.json", "probe.npz"):
            (point / name).unlink()
    return path, tmp_path / "runs"


@pytest.mark.parametrize(
    ("line", "said"),
    [
        ("finetune_curves: [eval/sucess]", "finetune_curves: no run has logged 'eval/sucess', did you mean 'eval/succ"),
        ("curves: [train/los]", "curves: no run has logged 'train/los', did you mean 'train/"),
    ],
)
def test_a_curve_that_no_run_has_logged_is_refused_by_name(made, tmp_path, line, said):
    path, runs = made
    path.write_text(f"{SUITE}{line}\n")
    with pytest.raises(UserError) as caught:
        report_suite(path, output=tmp_path / "out", runs=runs)
    assert said in str(caught.value) and str(path) in str(caught.value) and not (tmp_path / "out").exists()
    # A point that is not finished may log it yet.
    record = runs / "mazes/clean/vq/seed_1.json"
    record.write_text(record.read_text().replace('"finished": true', '"finished": false'))
    check_curves(load_results(read_suite(path), (0, 1), runs))


@pytest.fixture
def results(made):
    path, runs = made
    suite = read_suite(path)
    return load_results(suite, suite.seeds, runs)


def test_the_report_has_curves_and_maps_of_each_grid_and_the_numbers_of_both(made, tmp_path):
    path, runs = made
    report_suite(path, output=tmp_path / "a", runs=runs)
    report_suite(path, output=tmp_path / "b", runs=runs)
    names = {file.name for file in (tmp_path / "a").iterdir()}
    for grid in ("clean", "noisy"):
        assert {f"{grid}-learning-eval-success.png", f"{grid}-coverage.png", f"{grid}-topology.png"} <= names
    assert all((tmp_path / "a" / name).read_bytes() == (tmp_path / "b" / name).read_bytes() for name in names)
    text = (tmp_path / "a/report.md").read_text()
    assert "x.h5 (fingerprint abc) and noisy.h5 (fingerprint other)" in text
    (row,) = [line for line in text.splitlines() if line.startswith("| dqn/Free/coverage ↑ | 1.000")]
    assert row.count("1.000 (1.000) [1.000, 1.000]") == 3, "only the grid that has it, in all three settings"
    success = [line for line in text.splitlines() if line.startswith("| dqn/Spiral/success ↑ | 0.")]
    assert len(success) == 2 and "0.150 (0.150) [0.100, 0.200]" in success[0]
    assert "Free (env LoopWorld, env_options.goals none)" in text


def test_a_second_grids_claims_are_held_against_it(results):
    first, second = headline.verdicts(results)
    assert first.holds and first.estimate.value == pytest.approx(0.15)
    assert second.holds and second.estimate.value == pytest.approx(0.2)
    table = reports._headline_part(results)[0].tables[0]
    assert [row[1] for row in table.rows] == [
        "value of dqn/Spiral/success, scratch, 2 seeds",
        "difference of dqn/Spiral/success, vq against none (grid noisy), 2 seeds",
    ]
    assert all(row[3].endswith(", in the mean") for row in table.rows), "two seeds have no interval to judge by"


def test_other_data_within_a_store_is_refused_and_in_another_is_not(made):
    path, runs = made
    suite = read_suite(path)
    file = runs / "mazes/noisy/vq/seed_1.json"
    file.write_text(file.read_text().replace('"fingerprint": "other"', '"fingerprint": "third"'))
    with pytest.raises(UserError, match=r"noisy/vq/seed_1: was trained on other data than .*noisy/none/seed_0"):
        load_results(suite, suite.seeds, runs)


def test_learning_curves_are_means_over_seeds_and_can_be_read_again(results, tmp_path):
    grid = results.suite.grids[0]
    found = finetune_bands(results, grid)
    assert list(found) == ["dqn/Spiral/eval/success", "dqn/Arm/eval/success"], "Free has no such column"
    band = found["dqn/Spiral/eval/success"]["vq"]
    assert band.steps.tolist() == [100, 200] and band.mean == pytest.approx([0.25, 0.45]) and band.seeds == 2
    assert band.low == pytest.approx([0.2, 0.4]) and band.high == pytest.approx([0.3, 0.5])
    assert list(bands(results, grid)) == [], "of training none is asked for; scratch has none and is no error"

    write_bands(tmp_path / "curves.csv", {"clean": found})
    again = read_bands(tmp_path / "curves.csv")
    assert list(again) == ["clean"] and list(again["clean"]) == list(found)
    assert list(again["clean"]["dqn/Spiral/eval/success"]) == ["none", "vq", "scratch"]
    back = again["clean"]["dqn/Spiral/eval/success"]["vq"]
    for name in ("steps", "mean", "low", "high", "seeds"):
        assert np.asarray(getattr(back, name)) == pytest.approx(np.asarray(getattr(band, name)))
    assert learning_curves_figure(again["clean"]) == learning_curves_figure(found)
    assert learning_curves_figure(again["clean"], agent="ppo") is None


def test_every_line_of_a_figure_can_be_told_from_the_others():
    numbers = np.arange(2.0)
    settings = {f"s{i}": Band(numbers, numbers + i, numbers, numbers + i, 2) for i in range(7)}
    same = dict.fromkeys(settings, settings["s0"])
    alone = learning_curves_figure({"dqn/a/eval/success": settings})
    assert alone != learning_curves_figure({"dqn/a/eval/success": same}), "drawn by its numbers"
    both = {name: settings[name] for name in ("s0", "s6")}
    swapped = {"s0": settings["s6"], "s6": settings["s0"]}
    draw = [learning_curves_figure({"dqn/a/x": {**settings, **part}}) for part in (both, swapped)]
    assert draw[0] != draw[1], "the seventh line is not drawn like the first"


def test_files_that_are_something_else_are_named(tmp_path):
    for name in ("gone", "other"):
        path = tmp_path / name
        for read in (read_bands, read_maps):
            if name == "other":
                path.write_text('step,loss\n1,2\n["a"]\n')
            with pytest.raises(UserError, match=f"{path}: not the") as error:
                read(path)
            assert "\n" not in str(error.value)


def test_maps_are_the_means_of_the_seeds(results, tmp_path):
    found = mean_maps(results, results.suite.grids[0])
    assert list(found) == ["Spiral", "Free"] and list(found["Free"]) == ["none", "vq", "scratch"]
    part = found["Spiral"]["vq"]
    assert part.environment == "SpiralWorld" and part.seeds == 2 and part.topology == pytest.approx(0.55)
    assert part.visits.sum() == pytest.approx(1.0)
    assert part.visits[0, :3] == pytest.approx([3 / 40, 3 / 40, 1 / 40]), "5 and 1 of 40, each for one of the seeds"
    assert part.latent_distance == pytest.approx(np.arange(36).reshape(6, 6) / 35), "one seed's are twice as long"
    assert part.path_length[0, :3] == pytest.approx([3, 3, 1])

    maze_maps.write_maps(tmp_path / "maps.json", {"clean": found, "noisy": {}})
    again = read_maps(tmp_path / "maps.json")
    assert list(again) == ["clean", "noisy"] and again["noisy"] == {}
    back = again["clean"]["Spiral"]["vq"]
    assert back.latent_distance[0, 1] == 0.02857 and back.topology == 0.55 and back.seeds == 2
    assert back.visits == pytest.approx(part.visits, rel=1e-3)
    for draw in (coverage_figure, topology_figure):
        assert draw(again["clean"])[:8] == b"\x89PNG\r\n\x1a\n" and draw({}) is None


def test_only_the_maps_that_are_asked_for(made, tmp_path):
    path, runs = made
    path.write_text(SUITE + "maps: [scratch, vq]\n")
    report_suite(path, output=tmp_path / "a", runs=runs)
    maps = read_maps(tmp_path / "a/maps.json")
    assert list(maps["clean"]["Spiral"]) == ["vq", "scratch"] and list(maps["noisy"]["Spiral"]) == ["vq"]


def test_environments_without_maps_draw_none(results):
    shown = {"Arm": {"none": MeanMaps("RobotArm", 2)}}
    assert coverage_figure(shown) is None and topology_figure(shown) is None
    assert "Arm" not in mean_maps(results, results.suite.grids[0])


def test_a_figure_of_coverage_shows_the_numbers_and_the_walls():
    even = np.full((6, 6), 1 / 36)
    one = np.zeros((6, 6))
    one[0, 0] = 1.0
    pictures = [
        coverage_figure({"a": {"none": MeanMaps(world, 1, visits=visits)}})
        for world, visits in (("SpiralWorld", even), ("SpiralWorld", one), ("LoopWorld", even))
    ]
    assert len(set(pictures)) == 3


def test_an_encoder_that_tells_no_cells_apart_has_no_distances(made):
    path, runs = made
    for seed in (0, 1):
        file = runs / f"mazes/clean/vq/seed_{seed}/finetune/Spiral/outcome.json"
        content = json.loads(file.read_text())
        content["maps"]["latent_distance"] = np.zeros((6, 6)).tolist()
        file.write_text(json.dumps(content))
    suite = read_suite(path)
    found = mean_maps(load_results(suite, suite.seeds, runs), suite.grids[0])
    assert not found["Spiral"]["vq"].latent_distance.any() and topology_figure(found)


@pytest.mark.parametrize(
    ("measure", "wanted"),
    [
        ("dqn/Spiral/success", "up"), ("dqn/Spiral/steps_to_solve", "down"), ("dqn/Spiral/topology", "up"),
        ("dqn/noise/coverage", "up"), ("dqn/Spiral/straight_line", ""), ("dqn/cell/error", ""),
        ("dqn/Spiral/mean_success", "up"), ("dqn/Spiral/of/parts", ""),
    ],
)  # fmt: skip
def test_which_way_fine_tuning_is_better(measure, wanted):
    assert direction(measure, {"cell": "state", "noise": "noise"}) == wanted


def test_a_measure_that_some_seeds_lack_says_so(made, tmp_path):
    path, runs = made
    file = runs / "mazes/clean/vq/seed_1.json"
    content = json.loads(file.read_text())
    del content["metrics"]["dqn/Spiral/success"]
    file.write_text(json.dumps(content))
    report_suite(path, output=tmp_path / "a", runs=runs)
    assert "| 0.400 (0.400) n=1 |" in (tmp_path / "a/report.md").read_text()


def test_curves_of_both_kinds_are_in_one_file(made, tmp_path):
    path, runs = made
    path.write_text(SUITE + "curves: [train/raw/inverse]\nfinetune_curves: [eval/success, train/coverage]\n")
    report_suite(path, output=tmp_path / "a", runs=runs)
    rows = list(csv.DictReader((tmp_path / "a/curves.csv").read_text().splitlines()))
    columns = {(row["grid"], row["column"]) for row in rows if row["setting"] == "vq"}
    assert columns == {
        *((grid, "train/raw/inverse") for grid in ("clean", "noisy")),
        *((grid, "dqn/Spiral/eval/success") for grid in ("clean", "noisy")),
        *(("clean", f"dqn/{name}") for name in ("Arm/eval/success", "Free/train/coverage")),
    }
    assert {row["column"] for row in rows if row["setting"] == "scratch"} == {
        *("dqn/Spiral/eval/success", "dqn/Arm/eval/success", "dqn/Free/train/coverage")
    }
