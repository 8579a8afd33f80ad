"""Files of suites: which runs they mean, which of them are the same run, and one clear line for every mistake."""

from pathlib import Path

import pytest
import yaml

from repdib_lightning.configurations import packaged_suites, resolve
from repdib_lightning.errors import UserError
from repdib_lightning.experiments.points import points_of
from repdib_lightning.experiments.suite import check_seeds, identity
from repdib_lightning.experiments.suite_file import find_suite, read_suite

GOOD = """
base: [robot_arm]
data: data/robot_arm.h5
grids:
  bottleneck:
    vary: {config: [bottleneck/none, bottleneck/repdib]}
"""


def write(folder, text, name="mine.yaml"):
    path = folder / name
    path.write_text(text)
    return path


def settings(folder, grids, **more):
    tree = {"base": "robot_arm", "data": "data/robot_arm.h5", "grids": grids, **more}
    return read_suite(write(folder, yaml.safe_dump(tree, sort_keys=False)))


# the packaged suites


def test_the_packaged_suite_of_the_robot_arm():
    suite = read_suite("robot_arm")
    by_place = {setting.place: setting for grid in suite.grids for setting in grid.settings}
    assert list(by_place) == [
        *(f"bottleneck/{name}" for name in ("none", "vib", "vq", "repdib")),
        *(f"groups/groups_{groups}" for groups in (4, 8, 16, 32)),
    ]
    assert len(suite.settings) == 7
    shared = suite.run_by(by_place["groups/groups_8"])
    assert shared is by_place["bottleneck/repdib"]
    alone = [setting for place, setting in by_place.items() if place != "groups/groups_8"]
    assert all(suite.run_by(setting) is setting for setting in alone)

    points = points_of(suite, suite.seeds, Path("runs"))
    assert len(points) == 35 and len({point.folder for point in points}) == 35
    assert [point.seed for point in points[:8]] == [0] * 7 + [1]  # a whole table first
    assert points[0].folder == Path("runs/robot_arm/bottleneck/none/seed_0")
    assert points_of(suite, [3], Path("runs"), ["bottleneck/vq"])[0].name == "bottleneck/vq seed 3"


@pytest.mark.parametrize("name", sorted(packaged_suites()))
def test_every_packaged_suite_can_be_read(name):
    suite = read_suite(name)
    assert suite.name == name and suite.settings
    for grid in suite.grids:  # within a grid nothing is trained twice under two names
        assert len({identity(setting) for setting in grid.settings}) == len(grid.settings)


def test_a_setting_says_what_fit_is_given():
    suite = read_suite("robot_arm")
    setting = next(s for s in suite.settings if s.place == "groups/groups_16")
    assert setting.arguments(3) == [
        *("--config", "robot_arm", "--config", "bottleneck/repdib"),
        *("--data.path", "data/robot_arm.h5"),
        *("--model.bottleneck.init_args.groups", "16"),
        *("--seed_everything", "3", "--data.seed", "3"),
    ]


# suites of one's own


def test_what_a_small_file_leaves_out_has_defaults(tmp_path):
    suite = read_suite(write(tmp_path, GOOD + "collect:\nprobe:\nslurm:\n"))
    assert (suite.name, suite.title, suite.threads) == ("mine", "mine", 1)
    assert suite.seeds == (0, 1, 2, 3, 4) and suite.tune_seeds == (100, 101, 102)
    assert suite.collect == () and suite.probe == {} and suite.slurm == {}
    assert suite.grids[0].baseline == "none" and suite.grids[0].about == ""


def test_a_grid_is_every_combination_and_later_axes_change_first(tmp_path):
    suite = settings(tmp_path, {"g": {"vary": {"model.shift": [0, 2], "config": ["bottleneck/none", "bottleneck/vq"]}}})
    assert [setting.name for setting in suite.grids[0].settings] == [
        "shift_0-none",
        "shift_0-vq",
        "shift_2-none",
        "shift_2-vq",
    ]
    first = suite.grids[0].settings[0]
    assert first.merged["model"]["shift"] == 0
    assert first.merged["model"]["bottleneck"]["class_path"] == "Identity"
    assert first.merged["data"]["init_args"]["path"] == "data/robot_arm.h5"
    assert len(suite.settings) == 4


def test_values_reach_fit_as_it_reads_them(tmp_path):
    values = [True, None, 0.001, "ema", [1, 2]]
    grids = {"g": {"with": {f"model.key{i}": value for i, value in enumerate(values)}, "vary": {"model.x": [1]}}}
    words = settings(tmp_path, grids).settings[0].arguments(0)
    assert [words[words.index(f"--model.key{i}") + 1] for i in range(5)] == ["true", "null", "0.001", "ema", "[1, 2]"]
    assert all(yaml.safe_load(words[words.index(f"--model.key{i}") + 1]) == value for i, value in enumerate(values))


def test_grids_that_mean_the_same_run_share_it_and_others_do_not(tmp_path):
    key = "model.bottleneck.groups"
    suite = settings(
        tmp_path,
        {
            "one": {"with": {"config": "bottleneck/repdib"}, "vary": {key: [8, 16]}},
            "two": {
                "vary": {"config": ["bottleneck/vq", "bottleneck/repdib"], "model.bottleneck.init_args.groups": [16]}
            },
            "word": {"with": {key: 16}, "vary": {"model.bottleneck": ["Identity", "VectorQuantiser"]}},
        },
    )
    assert [setting.place for setting in suite.settings] == [
        *("one/groups_8", "one/groups_16", "two/vq-groups_16"),
        *("word/bottleneck_Identity", "word/bottleneck_VectorQuantiser"),
    ]
    orders = ({"trainer.a": 1, "trainer.b": 2}, {"trainer.b": 2, "trainer.a": 1})
    grids = {f"g{i}": {"with": given, "vary": {"model.shift": [1]}} for i, given in enumerate(orders)}
    assert len(settings(tmp_path, grids).settings) == 1


def test_configurations_beside_the_suite_are_found(tmp_path):
    write(tmp_path, "model: {shift: 1}\n", "less.yaml")
    suite = settings(tmp_path, {"g": {"vary": {"config": [["bottleneck/none", "less.yaml"], "less.yaml"]}}})
    assert [setting.name for setting in suite.settings] == ["none-less", "less"]
    assert suite.settings[0].merged["model"]["shift"] == 1
    write(tmp_path, "model: {shift: 3}\n", "more.yaml")
    over = settings(tmp_path, {"g": {"with": {"config": "less.yaml"}, "vary": {"config": ["more.yaml"]}}})
    assert over.settings[0].merged["model"]["shift"] == 3 and over.settings[0].configs[1:] == (
        str(tmp_path / "less.yaml"),
        str(tmp_path / "more.yaml"),
    )
    assert all(resolve(name).is_file() for name in suite.settings[0].configs)


def test_a_file_goes_before_a_packaged_suite_and_a_lost_path_is_no_packaged_suite(tmp_path, monkeypatch):
    assert find_suite("robot_arm") == find_suite("conf/suites/robot_arm.yaml").resolve()
    monkeypatch.chdir(tmp_path)
    assert find_suite("conf/suites/robot_arm.yaml") == find_suite("robot_arm.yaml") == packaged_suites()["robot_arm"]
    write(tmp_path, GOOD, "robot_arm.yaml")
    assert read_suite("robot_arm.yaml").file == Path("robot_arm.yaml")
    with pytest.raises(UserError, match=r"suite experiments/robot_arm\.yaml: no such file.*choices: .*robot_arm"):
        find_suite("experiments/robot_arm.yaml")
    with pytest.raises(UserError, match=r"suite robot_amr: no such file.*did you mean 'robot_arm'"):
        find_suite("robot_amr")


# mistakes


def changed(**keys):
    tree = yaml.safe_load(GOOD) | keys
    return yaml.safe_dump({key: value for key, value in tree.items() if value != "REMOVED"})


def grid(**keys):
    tree = {"vary": {"config": ["bottleneck/none", "bottleneck/repdib"]}} | keys
    return changed(grids={"bottleneck": {key: value for key, value in tree.items() if value != "REMOVED"}})


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", "a suite must map keys to values, is None"),
        ("- a\n- b\n", "a suite must map keys to values"),
        ("a: [1\nb: 2", "not valid YAML"),
        ("when: 2024-13-45\n", "not valid YAML"),
        ("a: \x00", "not valid YAML"),
        (changed(seed=[1]), r"unknown key 'seed', did you mean 'seeds'"),
        (changed(base="REMOVED"), "'base' is missing"),
        (changed(data="REMOVED"), "'data' is missing"),
        (changed(grids="REMOVED"), "'grids' is missing"),
        (changed(base="robot_amr"), "base: robot_amr: no such file.*did you mean 'robot_arm'"),
        (changed(base=None), "base: None: no such file"),
        (changed(data=None), "data must name a store"),
        (changed(data=["a.h5"]), "data must name a store"),
        (changed(collect=["robot_arm"]), "collect must be words"),
        (changed(threads=0), "threads must be at least 1, is 0"),
        (changed(threads="two"), "threads must be at least 1, is 'two'"),
        (changed(threads=True), "threads must be at least 1, is True"),
        (changed(seeds=[0, 1, 100]), "seeds: seed 100 is for development"),
        (changed(tune_seeds=[100, 99]), "tune_seeds: seed 99 is for reporting only"),
        (changed(seeds=[0, 1, 0]), "seeds names a seed twice"),
        (changed(seeds=[]), r"seeds must be a list of seeds such as \[0, 1, 2\]"),
        (changed(seeds=5), "seeds must be a list of seeds"),
        (changed(seeds=[-1]), "seeds must be a list of seeds"),
        (changed(seeds=[True]), "seeds must be a list of seeds"),
        (changed(seeds=["0"]), "seeds must be a list of seeds"),
        (changed(probe=["linear"]), "probe must map keys to values"),
        (changed(probe={"probs": "linear"}), r"unknown key 'probe\.probs', did you mean 'probes'"),
        (changed(slurm="gpu"), "slurm must map names to values"),
        (changed(headline=["state"]), "headline must map names to values"),
        (changed(grids={}), "grids must map names to grids"),
        (changed(grids=[1]), "grids must map names to grids"),
        (changed(grids={"g": None}), r"grids\.g must map keys to values, is None"),
        (changed(grids={"a/b": {"vary": {"model.shift": [1]}}}), "'a/b' cannot name a folder"),
        (changed(grids={"..": {"vary": {"model.shift": [1]}}}), r"'\.\.' cannot name a folder"),
        (changed(grids={3: {"vary": {"model.shift": [1]}}}), "3 cannot name a folder"),
        (grid(vary="REMOVED"), r"grids\.bottleneck\.vary must map keys to lists of values, is None"),
        (grid(vary={}), r"grids\.bottleneck\.vary must map keys to lists"),
        (grid(vary={"model.shift": 3}), r"grids\.bottleneck\.vary must map keys to lists"),
        (grid(vary={"model.shift": []}), r"grids\.bottleneck\.vary must map keys to lists"),
        (grid(vary=["model.shift"]), r"grids\.bottleneck\.vary must map keys to lists"),
        (grid(vary={1: [2]}), r"grids\.bottleneck\.vary: 1 is no dotted option"),
        (grid(vary={"model.name": ["a/b"]}), "'name_a/b' cannot name a folder"),
        (grid(vary={"model.name": ["a\nb"]}), r"'name_a\\nb' cannot name a folder"),
        (grid(vary={"model.name": [{"a": 1}]}), "cannot name a folder"),
        (grid(vary={"model.shift": [1, "1"]}), "two settings called 'shift_1'"),
        (grid(vary={"seed_everything": [1, 2]}), r"vary: 'seed_everything' follows from the suite's data and seeds"),
        (grid(vary={"data.path": ["a.h5", "b.h5"]}), r"vary: 'data\.path' follows from"),
        (
            grid(**{"with": {"data.init_args.seed": 3}}),
            r"grids\.bottleneck\.with: 'data\.init_args\.seed' follows from",
        ),
        (grid(**{"with": [1]}), r"grids\.bottleneck\.with must map names to values"),
        (grid(**{"with": {"config": "bottleneck/repdab"}}), r"grids\.bottleneck: bottleneck/repdab: .*did you mean"),
        (grid(vary={"config": ["bottleneck/non"]}), r"bottleneck/non: no such file.*did you mean 'bottleneck/none'"),
        (grid(baseline="nome"), r"grids\.bottleneck\.baseline: no setting is called 'nome', did you mean 'none'"),
        (grid(base="none"), r"unknown key 'grids\.bottleneck\.base', did you mean 'baseline'"),
    ],
)
def test_every_mistake_is_one_line_that_names_the_file_and_the_key(tmp_path, text, said):
    path = write(tmp_path, text)
    with pytest.raises(UserError, match=said) as error:
        read_suite(path)
    message = str(error.value)
    assert message.startswith(f"{path}: ") and "\n" not in message and len(message) < 600


def test_a_configuration_that_is_none_is_named(tmp_path):
    other = write(tmp_path, "[1, 2]\n", "list.yaml")
    with pytest.raises(UserError, match=r"list\.yaml: a configuration must map names to values") as error:
        read_suite(write(tmp_path, changed(base=str(other))))
    assert "\n" not in str(error.value)
    write(tmp_path, "a: [1\n", "list.yaml")
    with pytest.raises(UserError, match=r"mine\.yaml: base: .*list\.yaml: not valid YAML"):
        read_suite(write(tmp_path, changed(base=str(other))))


def test_reported_seeds_are_never_tuned_on_and_development_seeds_never_reported():
    check_seeds([0, 99], tune=False, where="--seeds")
    check_seeds([100, 5000], tune=True, where="--seeds")
    with pytest.raises(UserError, match=r"--seeds: seed 99 is for reporting only.*from 100 on"):
        check_seeds([100, 99], tune=True, where="--seeds")
    with pytest.raises(UserError, match=r"--seeds: seed 100 is for development.*add --tune"):
        check_seeds([0, 100], tune=False, where="--seeds")
