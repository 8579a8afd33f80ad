"""Files of suites with named settings, fine-tunings, and data of single grids."""

import inspect
from pathlib import Path

import pytest
import yaml

from repdib_lightning.bottlenecks import BOTTLENECKS
from repdib_lightning.errors import UserError
from repdib_lightning.evaluation.probes import DECODER, PROBES
from repdib_lightning.experiments.points import points_of
from repdib_lightning.experiments.suite_file import read_suite
from repdib_lightning.experiments.suite_measures import FACTOR_PROBES, PICTURE_PROBE, QUANTISERS

RUNS = {"Spiral": {"env": "SpiralWorld", "steps": 300, "env_options.goals": "none"}, "Loop": {"env": "LoopWorld"}}
FINETUNE = {"agent": "dqn", "with": {"steps": 200, "strides": [2, 2]}, "runs": RUNS}
GRID = {"settings": {"none": {"config": "bottleneck/none"}, "scratch": {"pretrained": False}}}
GROUPED = {"probes": "linear,groups"}
LATER = {"settings": {"own": {"config": "bottleneck/none"}}}


def text(grids=None, **more):
    tree = {"base": "robot_arm", "data": "data/a.h5", "finetune": FINETUNE, "grids": grids or {"g": GRID}, **more}
    return yaml.safe_dump({key: value for key, value in tree.items() if value != "REMOVED"}, sort_keys=False)


def read(folder, *args, **more):
    path = folder / "mine.yaml"
    path.write_text(text(*args, **more))
    return read_suite(path)


def place(suite, name):
    return next(setting for grid in suite.grids for setting in grid.settings if setting.place == name)


# what they mean


def test_named_settings_say_what_fit_is_given_over_what_they_share(tmp_path):
    grid = {
        "baseline": "b",
        "with": {"config": "bottleneck/repdib", "model.shift": 1},
        "settings": {"a": None, "b": {"config": "bottleneck/vq", "model.shift": 2}},
    }
    suite = read(tmp_path, {"g": grid}, finetune="REMOVED")
    first, second = suite.grids[0].settings
    assert (first.name, second.name) == ("a", "b") and suite.grids[0].baseline == "b"
    assert first.configs == ("robot_arm", "bottleneck/repdib") and first.merged["model"]["shift"] == 1
    assert second.configs == (*first.configs, "bottleneck/vq") and second.merged["model"]["shift"] == 2
    assert first.phases == ("fit", "export", "probe")


def test_fine_tunings_get_what_they_share_and_the_points_seed(tmp_path):
    suite = read(tmp_path)
    (point,) = points_of(suite, [3], Path("runs"), ["g/none"])
    assert point.setting.phases == ("fit", "export", "probe", "finetune")
    assert point.finetune == {
        "Spiral": [
            *("dqn", "--steps", "300", "--env", "SpiralWorld"),
            *("--env_options.goals", "none", "--seed", "3"),
        ],
        "Loop": ["dqn", "--steps", "200", "--env", "LoopWorld", "--seed", "3"],
    }
    assert point.finetune_folder("Loop") == Path("runs/mine/g/none/seed_3/finetune/Loop")


def test_options_of_a_fresh_encoder_are_for_settings_without_pre_training(tmp_path):
    (point,) = points_of(read(tmp_path), [3], Path("runs"), ["g/scratch"])
    assert point.finetune["Loop"] == [
        *("dqn", "--steps", "200", "--strides", "[2, 2]", "--env", "LoopWorld", "--seed", "3")
    ]


def test_without_pre_training_there_is_only_fine_tuning(tmp_path):
    grid = {**GRID, "with": {"model.shift": 2}}
    setting = place(read(tmp_path, {"g": grid}), "g/scratch")
    assert setting.phases == ("finetune",) and setting.arguments(0) == []
    assert setting.data is None and not setting.options and not setting.configs


def test_a_grid_lays_its_own_fine_tunings_data_and_collect_over_the_suites(tmp_path):
    grids = {
        "g": GRID,
        "noisy": {**GRID, "data": "data/b.h5", "collect": "maze --noise 1", "finetune": {"with": {"steps": 9}}},
        "still": {**GRID, "data": "data/c.h5"},
        "only": {**LATER, "finetune": {"runs": {}}},
    }
    suite = read(tmp_path, grids, collect="maze")
    assert [grid.data for grid in suite.grids] == [Path(f"data/{name}.h5") for name in "abca"]
    assert [grid.collect for grid in suite.grids] == [("maze",), ("maze", "--noise", "1"), (), ("maze",)]
    noisy = place(suite, "noisy/none")
    assert noisy.data == Path("data/b.h5") and noisy.merged["data"]["init_args"]["path"] == "data/b.h5"
    assert noisy.finetune.agent == "dqn" and noisy.finetune.runs["Loop"] == {"steps": 9, "env": "LoopWorld"}
    assert place(suite, "only/own").phases == ("fit", "export", "probe")


def test_a_grid_may_be_probed_on_a_store_of_its_own(tmp_path):
    grids = {
        "g": GRID,
        "h": {**GRID, "data": "data/b.h5", "probe_data": "data/q.h5", "probe_collect": "maze --samples 9"},
        "i": {**GRID, "probe_data": "data/r.h5"},
    }
    suite = read(tmp_path, grids, collect="maze", probe_data="data/p.h5", probe_collect="maze --samples 5")
    assert [grid.stores for grid in suite.grids] == [
        {Path("data/a.h5"): ("maze",), Path("data/p.h5"): ("maze", "--samples", "5")},
        {Path("data/b.h5"): (), Path("data/q.h5"): ("maze", "--samples", "9")},
        {Path("data/a.h5"): ("maze",), Path("data/r.h5"): ()},
    ]
    places = [place(suite, f"{name}/none") for name in "ghi"]
    assert [str(setting.probed_on) for setting in places] == ["data/p.h5", "data/q.h5", "data/r.h5"]
    assert [setting.merged["data"]["init_args"]["path"] for setting in places] == [f"data/{n}.h5" for n in "aba"]
    assert place(suite, "g/scratch").probed_on is None
    assert place(read(tmp_path), "g/none").probed_on == Path("data/a.h5")


# which are the same run


@pytest.mark.parametrize(
    ("change", "shared"),
    [
        ({}, True),
        ({"about": "other words"}, True),
        ({"data": "data/a.h5"}, True),
        ({"data": "data/b.h5"}, False),
        ({"probe_data": "data/b.h5"}, False),
        ({"finetune": {"with": {"steps": 9}}}, False),
        ({"finetune": {"runs": {}}}, False),
    ],
)
def test_a_run_is_shared_where_training_data_and_fine_tuning_agree(tmp_path, change, shared):
    suite = read(tmp_path, {"g": GRID, "later": {**LATER, **change}})
    ours = suite.run_by(place(suite, "later/own"))
    assert (ours is place(suite, "g/none")) == shared
    assert len(suite.settings) == (2 if shared else 3)


def test_without_pre_training_the_data_make_no_difference(tmp_path):
    suite = read(tmp_path, {"g": GRID, "noisy": {**GRID, "data": "data/b.h5"}})
    assert suite.run_by(place(suite, "noisy/scratch")) is place(suite, "g/scratch")
    assert suite.run_by(place(suite, "noisy/none")) is place(suite, "noisy/none")


# claims and figures


def test_a_claim_is_about_the_settings_of_its_grid(tmp_path):
    claim = {"setting": "own", "measure": "dqn/Spiral/success", "at_least": 0.5}
    suite = read(tmp_path, {"g": GRID, "later": LATER}, claims={"it works": {**claim, "grid": "later"}})
    assert suite.claims[0].grid == "later" and suite.grid("later").settings[0].name == "own"
    with pytest.raises(UserError, match=r"claims\.it works\.setting: 'own' is not known, choices: none, scratch"):
        read(tmp_path, {"g": GRID, "later": LATER}, claims={"it works": claim})
    with pytest.raises(UserError, match=r"claims\.it works\.grid: 'latter' is not known, did you mean 'later'"):
        read(tmp_path, {"g": GRID, "later": LATER}, claims={"it works": {**claim, "grid": "latter"}})


def test_maps_may_be_of_any_grids_settings_and_curves_have_a_default(tmp_path):
    suite = read(tmp_path, {"g": GRID, "later": LATER}, maps=["own", "scratch"])
    assert suite.maps == ("own", "scratch") and suite.finetune_curves == ("eval/success",)


def test_measures_of_probes_codes_training_and_fine_tuning_are_known(tmp_path):
    names = ["linear/cell/kept", "decoder/agent/rmse", "codes/used", "val/raw/inverse", "dqn/Loop/whatever"]
    assert read(tmp_path, measures=names, probe={"probes": ["linear", "decoder"]}).measures == tuple(names)
    assert (*FACTOR_PROBES, PICTURE_PROBE) == (*PROBES, DECODER)


# groups of the probe and of the bottleneck

QUANTISER, HALVES = {"config": "bottleneck/vq"}, {"probes": "linear,groups", "groups": 2}
OTHER_GROUPS = r"mine\.yaml: {}\.groups is 2, but '{}' quantises {} groups; set {}, or leave it out, in a 'probe' of a"


def probed(folder, setting, probe=HALVES, base="factors", own=None):
    """A suite of the settings ``plain`` and ``ours``, read by its probe or by one of their grid's own."""
    grid = {"settings": {"plain": {"config": "bottleneck/none"}, "ours": setting}}
    grid |= {} if own is None else {"probe": own}
    return read(folder, {"g": grid}, base=base, probe=probe, finetune="REMOVED")


@pytest.mark.parametrize(
    ("setting", "base", "groups"),
    [
        (QUANTISER, "factors", 8),
        ({"model.bottleneck.init_args.groups": 4}, "factors", 4),
        ({"model.bottleneck.groups": 4}, "factors", 4),
        ({**QUANTISER, "model.bottleneck.init_args.groups": 16}, "factors", 16),
        (None, "robot_arm", 8),
        ({"model.bottleneck": "repdib_lightning.bottlenecks.VectorQuantiser"}, "robot_arm", 8),
    ],
)
def test_a_probe_of_other_groups_than_a_settings_is_refused_before_anything_is_trained(tmp_path, setting, base, groups):
    for probe, own, key in ((HALVES, None, "probe"), (GROUPED, HALVES, r"grids\.g\.probe")):
        said = OTHER_GROUPS.format(key, "g/ours", groups, groups)
        with pytest.raises(UserError, match=said) as error:
            probed(tmp_path, setting, probe, base, own)
        assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    "setting",
    [
        {},
        {"model.bottleneck.init_args.groups": 2},
        {"model.bottleneck": "VectorQuantiser"},
        {"config": "bottleneck/vib"},
        {"model.bottleneck": "my.own.Bottleneck"},
        {"model.bottleneck": {"class_path": "Identity"}},
    ],
)
def test_a_probe_may_have_the_groups_of_a_setting_or_cut_what_has_none(tmp_path, setting):
    assert probed(tmp_path, setting).probe["groups"] == 2
    probed(tmp_path, setting, {**HALVES, "groups": "2"})


def test_a_grid_without_groups_of_its_own_probe_takes_any(tmp_path):
    assert probed(tmp_path, QUANTISER, probe=GROUPED).probe == GROUPED
    assert probed(tmp_path, QUANTISER, own=GROUPED).grids[0].probe == GROUPED
    assert probed(tmp_path, QUANTISER, own={**HALVES, "groups": 8}).grids[0].probe["groups"] == 8


def test_the_bottlenecks_that_take_groups_are_those_a_suite_knows():
    takes = {name for name, kind in BOTTLENECKS.items() if "groups" in inspect.signature(kind).parameters}
    assert takes == set(QUANTISERS)


# mistakes


def grid(**keys):
    return text({"g": {**GRID, **keys}})


def settings(**named):
    return text({"g": {"settings": named}})


def finetune(**keys):
    content = {key: value for key, value in {**FINETUNE, **keys}.items() if value != "REMOVED"}
    return text(finetune=content)


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (grid(vary={"model.shift": [1]}), r"grids\.g has both 'vary' and 'settings'"),
        (grid(setting={}), r"unknown key 'grids\.g\.setting', did you mean 'settings'"),
        (grid(settings=["none"]), r"grids\.g\.settings must map names to settings"),
        (grid(settings={}), r"grids\.g\.settings must map names to settings"),
        (grid(data=3), r"grids\.g\.data must name a store"),
        (grid(collect=["maze"]), r"grids\.g\.collect must be words of a collect command"),
        (grid(**{"with": {"pretrained": False}}), r"grids\.g: 'pretrained' is said of a single one"),
        (text({"g": {"vary": {"pretrained": [True]}}}), r"grids\.g\.vary: 'pretrained' cannot vary"),
        (settings(**{"a/b": {}}), "'a/b' cannot name a folder"),
        (settings(a="bottleneck/vq"), r"grids\.g\.settings\.a must map names to values"),
        (settings(a={"config": "bottleneck/vqq"}), r"grids\.g: bottleneck/vqq: .*did you mean 'bottleneck/vq'"),
        (settings(a={"data.path": "x"}), r"grids\.g\.settings\.a: 'data\.path' follows from"),
        (settings(a={"pretrained": "no"}), r"grids\.g\.settings\.a\.pretrained must be true or false, is 'no'"),
        (settings(a={"pretrained": False, "model.shift": 1}), r"settings\.a: 'model\.shift' means nothing without"),
        (text(finetune="REMOVED"), r"grids\.g\.settings\.scratch: neither pre-trained nor fine-tuned"),
        (grid(finetune={"runs": {}}), r"grids\.g\.settings\.scratch: neither pre-trained nor fine-tuned"),
        (
            text({"g": GRID, "h": {**LATER, "data": "data/a.h5", "collect": "other"}}, collect="maze"),
            r"grids\.h\.collect: data/a\.h5 is made by 'maze' for grid 'g'",
        ),
        (
            text({"g": GRID, "h": {**LATER, "probe_collect": "other"}}, probe_data="data/q.h5", probe_collect="maze"),
            r"grids\.h\.probe_collect: data/q\.h5 is made by 'maze' for grid 'g'",
        ),
        (text(probe_collect="maze"), r"yaml: probe_collect makes a store that is not named; add probe_data"),
        (grid(probe_collect="maze"), r"grids\.g\.probe_collect makes a store that is not named; add probe_data"),
        (grid(probe_data=3), r"grids\.g\.probe_data must name a store"),
        (finetune(agents="dqn"), r"unknown key 'finetune\.agents', did you mean 'agent'"),
        (finetune(agent="dqm"), r"finetune\.agent: 'dqm' is not known, did you mean 'dqn'"),
        (finetune(agent="REMOVED"), r"finetune\.agent must name an agent, such as dqn, is None"),
        (finetune(agent=["dqn"]), r"finetune\.agent must name an agent"),
        (finetune(runs=["Spiral"]), r"finetune\.runs must map names to values"),
        (finetune(runs={"a b": {"env": "LoopWorld"}}), r"finetune\.runs: 'a b' cannot name a folder"),
        (finetune(runs={"a": {}}), r"finetune\.runs\.a\.env must name an environment, such as SpiralWorld"),
        (
            finetune(runs={"a": {"env": "X", "step": 3}}),
            r"finetune\.runs\.a: 'step' is not known, did you mean 'steps'",
        ),
        (finetune(runs={"a": {"env": "X", "seed": 3}}), r"finetune\.runs\.a: 'seed' follows from"),
        (finetune(**{"with": {"encoder": "x"}}), r"finetune\.with: 'encoder' follows from"),
        (finetune(**{"with": {3: 4}}), r"finetune\.with: 3 is no option of finetune"),
        (text(finetune=["dqn"]), "finetune must map names to values"),
        (grid(finetune={"run": {}}), r"unknown key 'grids\.g\.finetune\.run', did you mean 'runs'"),
        (grid(finetune={"with": {"step": 3}}), r"grids\.g\.finetune\.with: 'step' is not known, did you mean 'steps'"),
        (
            text({"g": {"settings": {"a": {"pretraned": False}}}}),
            r"grids\.g\.settings\.a: 'pretraned' is not known, did you mean 'pretrained'",
        ),
        (text({"g": LATER}), r"finetune: 'strides' is of a fresh encoder, and every setting is pre-trained"),
        (
            text({"g": LATER}, finetune={**FINETUNE, "with": {}, "runs": {"a": {"env": "X", "features": 8}}}),
            r"finetune: 'features' is of a fresh encoder, and every setting is pre-trained",
        ),
        (text(measures=["dqm/Spiral/success"]), r"measures: 'dqm/Spiral/success': 'dqm' is no .*, did you mean 'dqn'"),
        (text(measures=["dqn/Spirall/success"]), r"no fine-tuning is called 'Spirall', did you mean 'Spiral'\?"),
        (text(measures=["dqn/Loop"]), r"measures: 'dqn/Loop': does not say what of the fine-tuning"),
        (text(measures=["linaer/cell/kept"]), r"'linaer' is no probe or agent here, did you mean 'linear'"),
        (text(measures=["linear/cell/keptt"]), r"must end in kept or error, did you mean 'kept'"),
        (text(measures=["mlp/cell/kept"], probe={"probes": "linear"}), r"'mlp' is no probe or agent here"),
        (text(measures=["decoder/agent/kept"]), r"'decoder' is no probe or agent here"),
        (text(measures=["groups/mgi"], probe=GROUPED), r"'mgi' is not measured, did you mean 'mig'"),
        (text(measures=["groups/hue/sharre"], probe=GROUPED), r"'sharre' of a factor is not measured"),
        (text({"g": {"settings": {"s": {"pretrained": False}}}}, measures=["codes/used"]), r"'codes' is no probe or"),
        (text(probe={"probes": "linear,mlpp"}), r"probe\.probes: 'mlpp' is not known, did you mean 'mlp'"),
        (text(probe={"probes": "decoder"}), r"probe\.probes: one of linear, mlp is needed"),
        (text(headline={"a": {"measure": "linaer/time", "paper": {}}}), r"headline\.a\.measure: .*mean 'linear'"),
        (
            text(
                {"g": GRID, "later": {**LATER, "finetune": {"runs": {"Other": {"env": "GridWorld"}}}}},
                claims={"c": {"grid": "later", "setting": "own", "measure": "dqn/Loop/success", "at_least": 0}},
            ),
            r"claims\.c\.measure: 'dqn/Loop/success': no fine-tuning is called 'Loop', choices: Other",
        ),
        (text(show=["scratch"]), r"show: 'scratch' is not pre-trained, it has no latents to show"),
        (text(maps=["scrotch"]), r"maps: 'scrotch' is not known, did you mean 'scratch'"),
        (text(finetune_curves="eval/success"), r"finetune_curves must be a list of words"),
    ],
)
def test_every_mistake_is_one_line_that_names_the_file_and_the_key(tmp_path, content, said):
    path = tmp_path / "mine.yaml"
    path.write_text(content)
    with pytest.raises(UserError, match=said) as error:
        read_suite(path)
    message = str(error.value)
    assert message.startswith(f"{path}: ") and "\n" not in message and len(message) < 600
