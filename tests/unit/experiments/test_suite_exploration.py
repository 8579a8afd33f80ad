"""Suites whose points explore: snapshots in the file, what is measured across them, and their part of the report."""

import io
import itertools
import json
import sys
from pathlib import Path

import numpy as np
import pytest
import yaml
from PIL import Image

sys.path.insert(0, str(Path(__file__).parent))
from finished_points import finish, typical

from repdib_lightning.errors import UserError
from repdib_lightning.experiments import headline
from repdib_lightning.experiments.comparison import differences, direction
from repdib_lightning.experiments.curves import Band, bands
from repdib_lightning.experiments.exploration_figures import (
    MOST_DOTS,
    Valued,
    read_valued,
    snapshot_curves,
    value_maps,
    value_range,
)
from repdib_lightning.experiments.exploration_part import exploration_parts
from repdib_lightning.experiments.points import points_of
from repdib_lightning.experiments.report import report_suite
from repdib_lightning.experiments.results import load_results
from repdib_lightning.experiments.snapshot_measures import rank_correlation, snapshot_measures
from repdib_lightning.experiments.suite import Finetune
from repdib_lightning.experiments.suite_file import read_suite

EXPLORING = {"class_path": "ExplorationDataModule", "init_args": {"snapshots": [100, 200, 400]}}
RUNS = {"walk": {"task": "walker-walk"}, "run": {"task": "walker-run"}}
FINETUNE = {"agent": "ddpg", "with": {"frames": 5000, "features": 64}, "snapshots": [400, 100, 200], "runs": RUNS}
SETTINGS = {"none": {"config": "bottleneck/none"}, "vq": {"config": "bottleneck/vq"}, "scratch": {"pretrained": False}}
GRID = {"walker": {"settings": SETTINGS}}


def write(folder, grids=None, data=EXPLORING, **more):
    (folder / "base.yaml").write_text(yaml.safe_dump({"data": data, "model": {"bottleneck": {"class_path": "RepDIB"}}}))
    tree = {"base": "base.yaml", "data": "data/probed.h5", "seeds": [0, 1], "finetune": FINETUNE}
    tree |= {"grids": grids or GRID, **more}
    path = folder / "explored.yaml"
    path.write_text(yaml.safe_dump(tree, sort_keys=False))
    return path


def setting(suite, place):
    return next(each for each in suite.settings if each.place == place)


# the file


def test_every_run_begins_at_every_snapshot_and_from_scratch_once(tmp_path):
    suite = read_suite(write(tmp_path))
    explored = setting(suite, "walker/vq")
    names = [f"{name}_{frames}" for name, frames in itertools.product(("walk", "run"), (100, 200, 400))]
    assert list(explored.finetune.runs) == names and explored.explores
    assert explored.finetune.arguments("run_200", 7) == [
        *("ddpg", "--frames", "5000", "--task", "walker-run", "--snapshot", "200", "--seed", "7")
    ]
    assert explored.finetune.snapshots["walk"] == {100: "walk_100", 200: "walk_200", 400: "walk_400"}
    scratch = setting(suite, "walker/scratch").finetune
    assert list(scratch.runs) == ["walk", "run"] and not scratch.snapshots
    assert scratch.runs["walk"] == {"frames": 5000, "features": 64, "task": "walker-walk"}


def test_an_agent_from_scratch_is_the_same_run_beside_encoders_that_are_trained_along(tmp_path):
    along = {"with": {**FINETUNE["with"], "frozen": False}, "snapshots": [400]}
    suite = read_suite(write(tmp_path, {**GRID, "along": {"finetune": along, "settings": SETTINGS}}))
    none, vq, scratch = suite.grid("along").settings
    assert none.finetune.runs["walk_400"]["frozen"] is vq.finetune.runs["run_400"]["frozen"] is False
    assert "frozen" not in scratch.finetune.runs["walk"]
    assert suite.run_by(scratch).place == "walker/scratch" and suite.run_by(vq).place == "along/vq"


def test_a_snapshot_is_of_the_run_and_without_one_the_bundle_is_given(tmp_path):
    grids = {**GRID, "end": {"finetune": {"snapshots": []}, "settings": {"own": {"config": "bottleneck/none"}}}}
    suite = read_suite(write(tmp_path, grids))
    given = {p.setting.place: (p.encoder_of(next(iter(p.finetune))), p.folder) for p in points_of(suite, [0], tmp_path)}
    encoder, run = given["walker/vq"]
    assert encoder == run
    encoder, run = given["end/own"]
    assert encoder == run / "bundle" and list(setting(suite, "end/own").finetune.runs) == ["walk", "run"]
    assert given["walker/scratch"][0] is None


def test_an_exploration_is_given_its_seed_and_no_data_but_is_probed_on_the_suites(tmp_path):
    explored = setting(read_suite(write(tmp_path)), "walker/vq")
    words = explored.arguments(5)
    assert "--data.path" not in words and words[words.index("--data.seed") + 1] == "5"
    assert explored.data == Path("data/probed.h5") and explored.phases == ("fit", "export", "probe", "finetune")
    trained = read_suite(write(tmp_path, data={"class_path": "EpisodeDataModule"}, finetune=None, grids={"g": TRAINED}))
    assert "--data.path" in trained.settings[0].arguments(5) and not trained.settings[0].explores


TRAINED = {"settings": {"none": {"config": "bottleneck/none"}}}
OWN = {"settings": {"vq": {"config": "bottleneck/vq", "data.snapshots": [100, 800]}}}


def finetune(**changes):
    return {"finetune": {key: value for key, value in {**FINETUNE, **changes}.items() if value != "REMOVED"}}


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (finetune(snapshots=[100, 250]), r"yaml: finetune\.snapshots: 'walker/none' writes no snapshot 250"),
        (
            {"grids": {"walker": OWN}, **finetune(**{"with": {}})},
            r"'walker/vq' writes no snapshot 200, its data\.snapshots are 100, 800$",
        ),
        (
            {"grids": {"g": {"settings": {"new": {"pretrained": False}}}}, **finetune(**{"with": {"frozen": False}})},
            r"finetune: 'frozen' is of an encoder that is given, and no setting is pre-trained$",
        ),
        ({"data": {"class_path": "ExplorationDataModule"}}, r"'walker/none' does not say which it writes; add data\."),
        ({"data": {"class_path": "EpisodeDataModule"}}, r"'walker/none' does not explore \(its data are no Exp"),
        (finetune(snapshots=400), r"finetune\.snapshots must list frames, such as \[5000, 10000\], is 400"),
        (finetune(snapshots=["a"]), r"finetune\.snapshots must list frames"),
        (finetune(snapshots=[True]), r"finetune\.snapshots must list frames"),
        (finetune(snapshots=[0]), r"finetune\.snapshots must list frames"),
        (finetune(snapshots=[100, 100]), r"finetune\.snapshots names a snapshot twice"),
        (finetune(snapshot=[100]), r"unknown key 'finetune\.snapshot', did you mean 'snapshots'"),
        (finetune(**{"with": {"snapshot": 100}}), r"finetune\.with: 'snapshot' is one of several; list them as snap"),
        (
            finetune(agent="dqn", runs={"maze": {"env": "LoopWorld"}}, **{"with": {"features": 8}}),
            r"finetune\.snapshots: 'dqn' takes no snapshots of an exploration; leave them out",
        ),
        (finetune(agent="td3bc", runs={"a": {}}, **{"with": {}}), r"finetune\.snapshots: 'td3bc' takes no snapshots"),
        (finetune(runs={"walk": {}}), r"finetune\.runs\.walk\.task must name a task, such as walker-run"),
        (finetune(runs={"walk": {"env": "Loop"}}), r"runs\.walk: 'env' is not known; this agent takes 'task'"),
        (finetune(runs={"all": RUNS["run"]}), r"finetune\.runs: 'all' is what the mean over all runs is called"),
        (
            finetune(runs={**RUNS, "run_200": RUNS["run"]}),
            r"finetune\.runs: 'run_200' is also what 'run' from snapshot 200 is called",
        ),
        ({"measures": ["ddpg/walk_300/return"]}, r"'ddpg/walk_300/return': no fine-tuning is called 'walk_300'"),
        ({"measures": ["ddpg/all/return"]}, r"measures: 'ddpg/all/return': no fine-tuning is called 'all'"),
        ({"measures": ["explor/coverage"]}, r"'explor' is no probe or agent here, did you mean 'explore'"),
    ],
)  # fmt: skip
def test_every_mistake_is_one_line_that_names_the_file_and_the_key(tmp_path, change, said):
    path = write(tmp_path, **change)
    with pytest.raises(UserError, match=said) as error:
        read_suite(path)
    message = str(error.value)
    assert message.startswith(f"{path}: ") and "\n" not in message


def test_measures_across_snapshots_may_be_named(tmp_path):
    names = ["ddpg/walk/monotone", "ddpg/all/monotone", "ddpg/run/return", "ddpg/run_100/return", "explore/coverage"]
    claim = {"setting": "vq", "measure": "ddpg/walk/monotone", "at_least": 0.0, "judge": "interval"}
    suite = read_suite(write(tmp_path, measures=names, claims={"helps": claim}))
    assert suite.measures == tuple(names)


# what is measured


def slow_spearman(frames, returns):
    """Pearson's correlation of the ranks, ties sharing the mean of theirs."""
    ranks = [[np.mean([a <= b for a in x]) + np.mean([a < b for a in x]) for b in x] for x in (frames, returns)]
    return np.corrcoef(*ranks)[0, 1]


@pytest.mark.parametrize(
    "returns", [(1, 2, 3, 4), (4, 3, 2, 1), (1, 3, 2, 4), (1, 4, 2, 3), (2.0, 2.0, 1.0, 5.0), (0.5, -3, 7, 7)]
)
def test_the_rank_correlation_is_that_of_the_ranks_and_knows_no_distances(returns):
    frames = (5000, 10000, 20000, 40000)
    found = rank_correlation(dict(zip(frames, returns, strict=True)))
    assert found == pytest.approx(slow_spearman(frames, returns))
    assert rank_correlation(dict(zip((1, 2, 3, 4), returns, strict=True))) == pytest.approx(found)


@pytest.mark.parametrize("returns", [{}, {1: 3.0}, {1: 3.0, 2: None}, {1: 3.0, 2: 3.0}])
def test_where_there_is_no_order_there_is_no_rank_correlation(returns):
    assert rank_correlation(returns) is None


def test_what_follows_from_the_snapshots():
    finetune = Finetune("ddpg", RUNS).from_snapshots([10, 20, 30])
    numbers = {"walk": (1.0, 2.0, 3.0), "run": (3.0, 1.0, 2.0)}
    metrics = {
        f"ddpg/{name}_{frames}/return": value
        for name, values in numbers.items()
        for frames, value in zip((10, 20, 30), values, strict=True)
    }
    metrics["ddpg/walk_30/mean_return"] = 0.5
    found = snapshot_measures(metrics, finetune)
    assert found == {
        "ddpg/walk/return": 3.0,
        "ddpg/walk/mean_return": 0.5,
        "ddpg/walk/monotone": 1.0,
        "ddpg/run/return": 2.0,
        "ddpg/run/monotone": pytest.approx(-0.5),
        "ddpg/all/monotone": pytest.approx(0.25),
    }
    del metrics["ddpg/run_20/return"]
    assert set(found) - set(snapshot_measures(metrics, finetune)) == {"ddpg/run/monotone", "ddpg/all/monotone"}
    assert snapshot_measures(metrics, Finetune("ddpg", RUNS)) == {} == snapshot_measures(metrics, None)


@pytest.mark.parametrize(
    ("measure", "wanted"),
    [
        *(("ddpg/walk/monotone", "up"), ("ddpg/all/monotone", "up"), ("ddpg/walk_100/return", "up")),
        *(("ddpg/walk/first_return", "up"), ("ddpg/walk/frames", "")),
        *(("explore/coverage", "up"), ("explore/coverage_share", "up"), ("explore/task_return", "")),
    ],
)
def test_which_way_is_better(measure, wanted):
    assert direction(measure, {}) == wanted


# the report

RETURNS = {"none": (30.0, 20.0, 10.0), "vq": (10.0, 20.0, 30.0)}


def explored(name, seed):
    """Returns that fall with the frames without a bottleneck and rise with one; more with the seed."""
    if name == "scratch":
        return {f"ddpg/{run}/{kind}": 15.0 + seed for run in RUNS for kind in ("return", "mean_return")}
    found = {
        f"ddpg/{run}_{frames}/{kind}": value + seed
        for run in RUNS
        for frames, value in zip((100, 200, 400), RETURNS[name], strict=True)
        for kind in ("return", "mean_return")
    }
    return {**typical(name, seed), "explore/coverage": 50.0 + seed, **found}


@pytest.fixture
def made(tmp_path):
    """A suite's file and the folder of its runs, all points finished."""
    claims = {
        "better": {"setting": "vq", "measure": "ddpg/walk/return", "of": "difference", "at_least": 19.0},
        "than scratch": {
            "setting": "vq",
            "than": "scratch",
            "measure": "ddpg/run/return",
            "of": "difference",
            "at_least": 14.9,
        },
        "monotone": {"setting": "none", "measure": "ddpg/all/monotone", "at_most": -0.9},
    }
    more = {"curves": ["explore/coverage"], "finetune_curves": ["eval/return"], "claims": claims}
    path = write(tmp_path, measures=["ddpg/walk/return", "ddpg/all/monotone", "explore/coverage"], **more)
    for point in finish(read_suite(path), tmp_path / "runs", explored):
        record = point.record()
        if point.setting.pretrained:
            record.data = {"file": "replay.h5", "fingerprint": f"own {point.name}"}
            record.probed = {"file": "probed.h5", "fingerprint": "abc"}
            rows = ["step,explore/coverage,train/loss", "0,10,", "0,20,", "5,,0.3", f"9,{30 + point.seed},"]
            (point.folder / "metrics.csv").write_text("\n".join(rows) + "\n")
        else:
            record.data = {}
        point.write(record)
        for place, name in enumerate(point.finetune):
            folder = point.finetune_folder(name)
            folder.mkdir(parents=True)
            content = {"environment": "control", "measures": {}, "maps": {}}
            (folder / "outcome.json").write_text(json.dumps(content))
            (folder / "progress.csv").write_text(f"step,eval/return\n0,{place}\n5000,{10 * place + point.seed}\n")
            generator = np.random.default_rng(place)
            latents = generator.normal(size=(40 + place, 5)).astype(np.float16)
            np.savez(folder / "values.npz", latents=latents, values=generator.random(40 + place, dtype=np.float32))
    return path, tmp_path / "runs"


@pytest.fixture
def results(made):
    suite = read_suite(made[0])
    return load_results(suite, suite.seeds, made[1])


def test_claims_and_differences_see_what_follows_from_the_snapshots(results):
    found = {verdict.claim.text: verdict for verdict in headline.verdicts(results)}
    assert found["better"].estimate.value == pytest.approx(20.0) and found["better"].holds
    assert found["than scratch"].estimate.value == pytest.approx(15.0), "of the largest snapshot against from scratch"
    assert found["monotone"].estimate.value == pytest.approx(-1.0) and found["monotone"].holds
    rows = {(row.setting, row.measure): row for row in differences(results, results.suite.grids[0])}
    assert rows["vq", "ddpg/walk/monotone"].difference.value == pytest.approx(2.0)
    assert rows["scratch", "ddpg/walk/return"].difference.value == pytest.approx(5.0)


def test_a_snapshot_that_is_no_longer_asked_for_does_not_count(made, tmp_path):
    suite = read_suite(write(tmp_path, finetune={**FINETUNE, "snapshots": [100, 200]}))
    results = load_results(suite, suite.seeds, made[1])
    assert not results.missing
    assert results.values(setting(suite, "walker/vq"), "ddpg/walk/return") == {0: 20.0, 1: 21.0}


def test_the_table_has_every_snapshot_and_from_scratch_on_a_line_of_its_own(results):
    (part,) = exploration_parts(results, results.suite.grids[0], {})
    (table,) = part.tables
    rows = {row[0]: row[1:] for row in table.rows}
    assert table.header == ["mean [95 % interval]", "none", "vq", "scratch"]
    assert rows["walk: return at the end, after 100 frames"] == ["30.5 [30.0, 31.0]", "10.5 [10.0, 11.0]", "-"]
    assert rows["run: mean return of the curve, after 400 frames"] == ["10.5 [10.0, 11.0]", "30.5 [30.0, 31.0]", "-"]
    assert rows["walk: return at the end, from scratch"] == ["-", "-", "15.5 [15.0, 16.0]"]
    assert rows["walk: rank correlation"] == ["-1.00 [-1.00, -1.00]", "1.00 [1.00, 1.00]", "-"]
    assert rows["mean of all: rank correlation"][:2] == rows["walk: rank correlation"][:2]
    assert len(rows) == 2 * (2 * 4 + 1) + 1
    assert "100, 200 and 400 frames of exploration: walk (frames 5000, task walker-walk); run (" in part.sentences[0]


def test_one_snapshot_has_no_rank(made, tmp_path):
    suite = read_suite(write(tmp_path, finetune={**FINETUNE, "snapshots": [400]}))
    (part,) = exploration_parts(load_results(suite, suite.seeds, made[1]), suite.grids[0], {})
    told = " ".join([*part.sentences, *(row[0] for row in part.tables[0].rows)])
    assert "after 400 frames" in told and "rank" not in told.lower()


def test_a_grid_without_snapshots_has_no_such_part(tmp_path):
    suite = read_suite(write(tmp_path, finetune=None, grids={"g": TRAINED}))
    finish(suite, tmp_path / "runs", typical)
    assert exploration_parts(load_results(suite, suite.seeds, tmp_path / "runs"), suite.grids[0], {}) == []


def test_the_report_shows_curves_and_values_and_says_what_each_was_trained_and_probed_on(made, tmp_path):
    path, runs = made
    report_suite(path, output=tmp_path / "a", runs=runs)
    report_suite(path, output=tmp_path / "b", runs=runs)
    names = {file.name for file in (tmp_path / "a").iterdir()}
    for task in RUNS:
        assert {f"walker-snapshots-{task}-eval-return.png", f"walker-values-{task}.png"} <= names
    assert "walker-curves.png" in names and not [name for name in names if "learning" in name]
    assert all((tmp_path / "a" / name).read_bytes() == (tmp_path / "b" / name).read_bytes() for name in names)
    text = (tmp_path / "a/report.md").read_text()
    assert "each exploration on a replay of its own and probed on probed.h5 (fingerprint abc)" in text
    assert "own walker" not in text
    assert "walk: t-SNE of latents met after fine-tuning from the last snapshot, seed 0" in text
    assert "| ddpg/all/monotone ↑ | -1.000" in text
    assert '"ddpg/walk/monotone"' in (tmp_path / "a/points.jsonl").read_text()


def test_explorations_that_were_probed_on_other_data_are_refused_and_other_replays_are_not(made):
    path, runs = made
    suite = read_suite(path)
    file = runs / "explored/walker/vq/seed_1.json"
    file.write_text(file.read_text().replace('"fingerprint": "abc"', '"fingerprint": "other"'))
    with pytest.raises(UserError, match=r"vq/seed_1: was probed on other data than .*none/seed_0"):
        load_results(suite, suite.seeds, runs)


def test_a_column_that_is_seldom_logged_is_drawn_where_it_was(results):
    """Several episodes may end before the first update: the last of them counts."""
    band = bands(results, results.suite.grids[0])["explore/coverage"]["vq"]
    assert band.steps.tolist() == [0, 9] and band.mean.tolist() == [20.0, 30.5] and band.seeds == 2


# the figures


def drawn(content):
    return np.asarray(Image.open(io.BytesIO(content)).convert("RGB"))


def band(*values):
    numbers = np.array(values, float)
    return Band(np.arange(len(values)), numbers, numbers - 1, numbers + 1, 3)


def test_curves_of_snapshots_are_drawn_by_their_numbers_and_frames():
    panels = {"none": {100: band(1, 2), 400: band(2, 5)}, "vq": {100: band(0, 1)}}
    scratch = {"scratch": band(1, 1)}
    shown = snapshot_curves(panels, scratch, task="walk", column="eval/return")
    assert shown == snapshot_curves(panels, scratch, task="walk", column="eval/return")
    others = (
        ({**panels, "vq": {400: band(0, 1)}}, scratch),
        (panels, {}),
        ({**panels, "vq": {100: band(0, 4)}}, scratch),
    )
    assert len({shown, *(snapshot_curves(*other, task="walk", column="eval/return") for other in others)}) == 4
    assert snapshot_curves({"none": {}}, scratch, task="walk", column="eval/return") is None


def valued(rows, lowest, highest, seed=0):
    generator = np.random.default_rng(seed)
    return Valued(generator.normal(size=(rows, 4)).astype(np.float32), np.linspace(lowest, highest, rows))


def test_settings_share_a_scale_of_values_from_purple_to_yellow():
    """The values of one setting are all low beside those of the other: its dots are purple, none is yellow."""
    low, high = valued(60, 0.0, 1.0), valued(60, 99.0, 100.0, seed=1)
    both = drawn(value_maps({"low": low, "high": high}, task="walk"))
    left, right = both[40:, : both.shape[1] // 2 - 30], both[40:, both.shape[1] // 2 : -90]
    yellow, purple = [np.array(colour) for colour in ((253, 231, 36), (68, 1, 84))]

    def share(part, wanted):
        return np.mean(np.abs(part.reshape(-1, 3).astype(int) - wanted).max(1) < 12)

    assert share(left, purple) > 0.001 and share(left, yellow) == 0
    assert share(right, yellow) > 0.001 and share(right, purple) == 0
    assert value_range({"low": low, "high": high}) == (0.0, 100.0)


def test_as_many_dots_of_each_setting_and_never_more_than_there_may_be(monkeypatch):
    monkeypatch.setattr("repdib_lightning.experiments.exploration_figures.tsne", lambda latents: latents[:, :2])
    few, many = valued(50, 0.0, 1.0), valued(4 * MOST_DOTS, 0.0, 1.0, seed=1)
    assert value_maps({"few": few, "many": many}, task="w") == value_maps(
        {"few": few, "many": many.thinned(50)}, task="w"
    )
    assert value_maps({"many": many}, task="w") == value_maps({"many": many.thinned(MOST_DOTS)}, task="w")
    kept = many.thinned(50)
    assert kept.values[[0, -1]].tolist() == [0.0, 1.0] and len(kept.latents) == 50
    assert value_maps({}, task="w") is None and value_maps({"two": valued(2, 0, 1)}, task="w") is None


@pytest.mark.parametrize(
    "arrays",
    [
        {"latents": np.zeros((3, 2))},
        {"latents": np.zeros((3, 2)), "values": np.zeros(4)},
        {"latents": np.zeros(3), "values": np.zeros(3)},
        {"latents": np.zeros((0, 2)), "values": np.zeros(0)},
        {"latents": np.zeros((3, 2)), "values": np.array([0.0, np.nan, 1.0])},
        {"latents": np.zeros((3, 2)), "values": np.array([object()] * 3)},
    ],
)
def test_values_that_are_none_are_refused_in_one_line(tmp_path, arrays):
    path = tmp_path / "values.npz"
    np.savez(path, **arrays)
    with pytest.raises(UserError, match=f"{path}: not the values of a fine-tuning") as error:
        read_valued(path)
    assert "\n" not in str(error.value)
    path.write_bytes(b"PK")
    with pytest.raises(UserError, match="not the values of a fine-tuning"):
        read_valued(path)
