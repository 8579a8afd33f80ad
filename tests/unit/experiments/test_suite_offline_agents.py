"""Suites of agents that learn from data, grids with fewer seeds, and films in the report."""

import inspect
import json
import sys
from importlib import import_module
from pathlib import Path

import numpy as np
import pytest
import yaml

sys.path.insert(0, str(Path(__file__).parent))
from finished_points import finish, typical

from repdib_lightning.data.episodes import EpisodeStore
from repdib_lightning.errors import UserError
from repdib_lightning.experiments import headline
from repdib_lightning.experiments.attempt import Attempt
from repdib_lightning.experiments.film_part import frames_of
from repdib_lightning.experiments.measures import collect_measures
from repdib_lightning.experiments.points import points_of
from repdib_lightning.experiments.report import report_suite
from repdib_lightning.experiments.results import load_results
from repdib_lightning.experiments.run import check_recorded_as
from repdib_lightning.experiments.suite_file import read_suite
from repdib_lightning.rl import AGENTS, RESUMABLE
from repdib_lightning.rl.film import side_by_side, write_film

AGENT = {"agent": "td3bc", "with": {"steps": 200}, "runs": {"walk": None, "far": {"gamma": 0.9}}}
HEAD = {"settings": {"none": {"config": "bottleneck/none"}, "scratch": {"pretrained": False}}}
TAIL = {
    "seeds": [0, 1],
    "settings": {"none": {"config": "bottleneck/none"}, "vq": {"config": "bottleneck/vq"}},
}


def write(folder, **more) -> Path:
    tree = {"base": "robot_arm", "data": "data/a.h5", "seeds": [0, 1, 2], "finetune": AGENT}
    tree |= {"grids": {"head": HEAD, "tail": TAIL}, **more}
    path = folder / "offline.yaml"
    path.write_text(yaml.safe_dump(tree, sort_keys=False))
    return path


def test_an_agent_that_learns_from_data_is_given_its_grids_store_and_needs_no_environment(tmp_path):
    other = {"data": "data/b.h5", "settings": {"none": {"config": "bottleneck/none"}}}
    suite = read_suite(write(tmp_path, grids={"head": HEAD, "other": other}))
    by_place = {setting.place: setting for setting in suite.settings}
    assert by_place["head/none"].finetune.arguments("walk", 3) == [
        *("td3bc", "--data", "data/a.h5", "--steps", "200", "--seed", "3")
    ]
    assert by_place["other/none"].finetune.runs["far"]["data"] == "data/b.h5"
    scratch = by_place["head/scratch"]
    assert scratch.data == Path("data/a.h5") and scratch.phases == ("finetune",)
    with pytest.raises(UserError, match="'data' follows from the suite's seeds and runs"):
        read_suite(write(tmp_path, finetune={**AGENT, "with": {"data": "data/c.h5"}}))


@pytest.mark.parametrize(("agent", "goes_on"), [("td3bc", False), ("dt", True)])
def test_a_fine_tuning_that_was_ended_goes_on_where_its_agent_can(tmp_path, agent, goes_on):
    suite = read_suite(write(tmp_path, finetune={"agent": agent, "runs": {"walk": None}}))
    (point,) = points_of(suite, [0], tmp_path, ["head/none"])
    folder = point.finetune_folder("walk")
    assert Attempt(point)._finetune_options("walk")[-2:] == ["--run", str(folder)]
    folder.mkdir(parents=True)
    (folder / "checkpoint").touch()
    assert Attempt(point)._finetune_options("walk")[-2:] == ["--run", str(folder)] and not folder.exists()
    folder.mkdir()
    (folder / "finetune.json").write_text("{}")
    resumed = Attempt(point)._finetune_options("walk")[-2:] == ["--resume", "true"]
    assert resumed == folder.exists() == goes_on


def test_the_agents_that_can_go_on_are_those_that_take_the_option():
    functions = {name: place.split(":") for name, place in AGENTS.items()}
    taken = {name: inspect.signature(getattr(import_module(m), f)).parameters for name, (m, f) in functions.items()}
    assert set(RESUMABLE) == {name for name, parameters in taken.items() if "resume" in parameters}


def test_a_grid_may_have_fewer_seeds_and_a_setting_of_two_grids_has_those_of_both(tmp_path):
    suite = read_suite(write(tmp_path))
    seeds = {}
    for point in points_of(suite, suite.seeds, tmp_path):
        seeds.setdefault(point.setting.place, []).append(point.seed)
    assert seeds == {"head/none": [0, 1, 2], "head/scratch": [0, 1, 2], "tail/vq": [0, 1]}
    assert [p.seed for p in points_of(suite, [7], tmp_path, ["tail/vq"])] == [7], "asked for by name, it is run"
    with pytest.raises(UserError, match=r"grids\.tail\.seeds must be a list of seeds"):
        read_suite(write(tmp_path, grids={"tail": {**TAIL, "seeds": 3}}))
    with pytest.raises(UserError, match="seed 100 is for development"):
        read_suite(write(tmp_path, grids={"tail": {**TAIL, "seeds": [100]}}))


def test_the_data_of_a_run_without_pretraining_are_those_of_its_agent(tmp_path):
    outcome = {"agent": "td3bc", "versions": {}, "configuration": {}, "measures": {"return": 5.0}, "maps": {}}
    path = tmp_path / "outcome.json"
    path.write_text(json.dumps({**outcome, "data": {"file": "a.h5", "fingerprint": "abc"}}))
    facts = collect_measures(tmp_path, None, {"walk": path})
    assert facts.data["fingerprint"] == "abc" and facts.metrics == {"td3bc/walk/return": 5.0}


def test_a_record_names_the_encoder_within_its_folder_and_no_folder_of_the_machine(tmp_path):
    path = tmp_path / "outcome.json"
    recorded_of = {str(tmp_path / "bundle"): "bundle", "/elsewhere/bundle": "/elsewhere/bundle", None: None}
    for encoder, recorded in recorded_of.items():
        options = {"encoder": encoder, "steps": 5}
        path.write_text(json.dumps({"agent": "bc", "versions": {}, "configuration": options, "measures": {}}))
        used = collect_measures(tmp_path, None, {"walk": path}).configuration["finetune"]["walk"]
        assert used == {"encoder": recorded, "steps": 5}


def test_the_report_holds_the_films_of_the_settings_that_are_named(tmp_path):
    path = write(tmp_path, films=["head/scratch", "tail/vq"])
    suite, runs = read_suite(path), tmp_path / "runs"
    for point in finish(suite, runs, lambda setting, seed: {**typical(setting, seed), "td3bc/walk/return": 1.0}):
        for name in ("walk", "far"):
            folder = point.finetune_folder(name)
            folder.mkdir(parents=True)
            (folder / "progress.csv").write_text("step,eval/return\n100,1\n200,2\n")
            content = {"agent": "td3bc", "environment": "control", "measures": {}, "maps": {}}
            (folder / "outcome.json").write_text(json.dumps(content))
        shade = 40 * point.seed + 100
        write_film(point.finetune_folder("walk") / "evaluation.mp4", np.full((9, 16, 16, 3), shade, np.uint8))
    output = tmp_path / "out"
    report_suite(path, output=output, runs=runs)
    films = sorted(file.name for file in output.glob("*.mp4"))
    assert films == ["film-head-scratch-walk.mp4", "film-tail-vq-walk.mp4"]
    assert abs(int(frames_of(output / films[0], 3).mean()) - 100) < 5, "of the first seed"
    page = (output / "report.html").read_text()
    assert page.count("<video") == 2 and (output / "films.png").is_file()
    assert "[film-tail-vq-walk](film-tail-vq-walk.mp4)" in (output / "report.md").read_text()
    with pytest.raises(UserError, match=r"films.*'head/vq'"):
        read_suite(write(tmp_path, films=["head/vq"]))


def test_an_overview_draws_a_measure_over_all_grids_that_have_it(tmp_path):
    path = write(tmp_path, finetune=None, overview=["linear/cell/kept", "val/raw/inverse"], grids={"tail": TAIL})
    suite, runs = read_suite(path), tmp_path / "runs"
    finish(suite, runs, typical)
    said = report_suite(path, output=tmp_path / "out", runs=runs)
    assert "linear" in said, "the terminal shows the first tables"
    page = (tmp_path / "out/report.md").read_text()
    assert page.index("## Overview") < page.index("## Grid: tail")
    for name in ("overview-linear-cell-kept", "overview-val-raw-inverse"):
        assert f"![{name}]({name}.png)" in page and (tmp_path / "out" / f"{name}.png").stat().st_size > 1000
    with pytest.raises(UserError, match="overview: no point has 'linear/cel/kept', did you mean 'linear/cell/kept'"):
        report_suite(write(tmp_path, finetune=None, overview=["linear/cel/kept"], grids={"tail": TAIL}), runs=runs)


def test_films_of_different_lengths_stand_side_by_side(tmp_path):
    short, long = np.full((2, 4, 4, 3), 10, np.uint8), np.full((3, 4, 6, 3), 200, np.uint8)
    both = side_by_side([short, long])
    assert both.shape == (3, 4, 4 + 4 + 6, 3)
    assert (both[2, :, :4] == 10).all() and (both[:, :, 4:8] == 255).all() and (both[:, :, 8:] == 200).all()
    (tmp_path / "film.mp4").write_bytes(b"no film")
    with pytest.raises(UserError, match=r"film\.mp4: not a readable film"):
        frames_of(tmp_path / "film.mp4", 2)


def test_a_grid_may_be_probed_otherwise(tmp_path):
    suite = read_suite(
        write(tmp_path, probe={"probes": "linear"}, grids={"head": {**HEAD, "probe": {"seed": 3}}, "tail": TAIL})
    )
    asked = {setting.place: suite.probe_of(setting) for setting in suite.settings}
    assert asked == {"head/none": {"seed": 3}, "head/scratch": {"seed": 3}, "tail/vq": {"probes": "linear"}}
    for probe, said in (
        ({"probe": "mlp"}, "unknown key 'grids.tail.probe.probe'"),
        ({"probes": "liner"}, "'liner' is not known"),
    ):
        with pytest.raises(UserError, match=said):
            read_suite(write(tmp_path, grids={"tail": {**TAIL, "probe": probe}}))


def test_a_run_that_grids_share_is_probed_by_the_first_one_which_must_have_all_probes(tmp_path):
    wider = {**TAIL, "probe": {"probes": "linear,decoder"}}
    with pytest.raises(
        UserError, match=r"grids\.tail: 'none' is run once, for grid 'head', whose probes lack 'decoder'"
    ):
        read_suite(write(tmp_path, probe={"probes": "linear"}, grids={"head": HEAD, "tail": wider}))
    read_suite(write(tmp_path, probe={"probes": "linear"}, grids={"tail": wider, "head": HEAD}))


def test_a_grid_shows_its_own_seeds_and_three_seeds_prove_nothing(tmp_path):
    claim = {"setting": "none", "grid": "tail", "measure": "linear/cell/kept", "at_least": 0.5, "judge": "interval"}
    alone = {"settings": {"none": {"config": "bottleneck/none"}}}
    path = write(tmp_path, finetune=None, claims={"kept": claim}, grids={"head": alone, "tail": TAIL})
    suite, runs = read_suite(path), tmp_path / "runs"
    finish(suite, runs, typical)
    results = load_results(suite, suite.seeds, runs)
    first, second = (next(s for s in grid.settings if s.name == "none") for grid in suite.grids)
    assert sorted(results.values(first, "linear/cell/kept")) == [0, 1, 2]
    assert sorted(results.values(second, "linear/cell/kept")) == [0, 1]
    (verdict,) = headline.verdicts(results)
    assert verdict.estimate.value == 1.0 and verdict.holds is None and verdict.seeds == 2


def test_a_store_that_was_recorded_otherwise_than_the_suite_says_is_refused(tmp_path, make_store):
    recorded = {"distractors": "video", "samples": 10}
    store = EpisodeStore(make_store(tmp_path / "a.h5", attributes={"configuration": recorded}))
    check_recorded_as(store, ["control", "--distractors", "video", "--quality", "fast"], Path("s.yaml"))
    check_recorded_as(store, [], Path("s.yaml"))
    with pytest.raises(UserError, match=r"a\.h5: was recorded with distractors video, s\.yaml collects it with image"):
        check_recorded_as(store, ["control", "--distractors", "image"], Path("s.yaml"))
