"""Every YAML under conf/ and every command of the README runs through the real entry point, on small data."""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
import tomllib
from functools import partial
from pathlib import Path

import pytest
import yaml

sys.path.insert(0, str(Path(__file__).parent))
sys.path.insert(0, str(Path(__file__).parents[1]))
import clip_stores
from killing import command_in_processes

from repdib_lightning.__main__ import VERBS, main
from repdib_lightning.configurations import packaged, packaged_suites
from repdib_lightning.data.frame_features import store_features
from repdib_lightning.environments.collect_atari import collect_atari
from repdib_lightning.environments.collect_control import collect_control
from repdib_lightning.environments.collect_emoji_styles import collect_emoji_styles
from repdib_lightning.environments.collect_maze import collect_maze
from repdib_lightning.environments.collect_robot_arm import collect_robot_arm
from repdib_lightning.environments.collect_smartwatch import collect_smartwatch
from repdib_lightning.evaluation import group_drawing
from repdib_lightning.evaluation.factor_classifier import judge_of
from repdib_lightning.experiments.suite_file import read_suite

ROOT = Path(__file__).parents[2]
SMALL = ["--data.batch_size", "8", "--trainer.max_steps", "3", "--trainer.val_check_interval", "2",
         "--trainer.limit_val_batches", "1", "--trainer.enable_progress_bar", "false"]  # fmt: skip
QUANTISER_AT_ONCE = ["--model.bottleneck.init_args.start_step", "1"]


@pytest.fixture(scope="session")
def recording(tmp_path_factory):
    """A short recording of the real arm at the real size."""
    path = tmp_path_factory.mktemp("arm") / "robot_arm.h5"
    return collect_robot_arm(path, samples=240, episode_length=24, workers=1, progress=False)


@pytest.fixture(scope="session")
def maze_recording(tmp_path_factory):
    """A short recording of GridWorld at the real size."""
    path = tmp_path_factory.mktemp("maze") / "gridworld.h5"
    return collect_maze(path, samples=240, episode_length=24, progress=False)


@pytest.fixture(scope="session")
def control_recording(tmp_path_factory):
    """A short recording of the walker at the real size, with few actions an episode."""
    path = tmp_path_factory.mktemp("control") / "walker.h5"
    chosen = {"behaviour": "random", "distractors": "video", "action_repeat": 25}
    return collect_control(path, samples=200, workers=1, progress=False, **chosen)


@pytest.fixture(scope="session")
def atari_recording(tmp_path_factory):
    """Twenty short games of Breakout at the real size."""
    path = tmp_path_factory.mktemp("atari") / "breakout.h5"
    return collect_atari(path, samples=800, max_frames=160, mixture={"random": 1.0}, workers=1, progress=False)


@pytest.fixture(scope="session")
def drawings(tmp_path_factory):
    """Drawings at the real size, some of the styles and species."""
    folder = tmp_path_factory.mktemp("drawings")
    for style in ("noto", "twemoji"):
        (folder / "few" / style).mkdir(parents=True)
        for file in sorted((ROOT / "data/emoji_styles" / style).glob("*.png"))[:20]:
            shutil.copy(file, folder / "few" / style)
    for name, size in (("emoji_styles", 64), ("pacs_elephants", 224)):
        collect_emoji_styles(folder / f"{name}.h5", source=folder / "few", size=size, progress=False)
    return folder


@pytest.fixture(scope="session")
def clips(tmp_path_factory):
    """Clips of twenty people in five sessions, the same with features of frames, and recordings of a smartwatch."""
    folder = tmp_path_factory.mktemp("clips")
    few = {"activities": 2, "subjects": 20, "frames": 2, "steps": 12}
    clip_stores.write_clips(folder / "activities.h5", clips=200, sessions=5, **few)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(clip_stores, "VIEWS", ("cam1", "cam3"))
        clip_stores.write_clips(folder / "frames.h5", clips=40, missing=False, **few)
    store_features(folder / "frames.h5", folder / "mmact.h5", device="cpu", progress=False)
    collect_smartwatch(folder / "smartwatch.h5", hop=30.0, progress=False)
    return folder


@pytest.fixture
def here(tmp_path, monkeypatch, recording, maze_recording, control_recording, atari_recording, drawings, clips):
    monkeypatch.chdir(tmp_path)
    Path("data").mkdir()
    for name in ("walker_walk_video", "walker_walk_demo", "vd4rl_walker_walk_video"):
        Path(f"data/{name}.h5").hardlink_to(control_recording)
    Path("data/gridworld.h5").hardlink_to(maze_recording)
    for name in ("emoji_styles", "pacs_elephants"):
        Path(f"data/{name}.h5").hardlink_to(drawings / f"{name}.h5")
    for name in ("activities", "mmact", "smartwatch"):
        Path(f"data/{name}.h5").hardlink_to(clips / f"{name}.h5")
    for name in ("breakout", "pong", "qbert", "seaquest"):
        for stem in (name, f"{name}_probe", f"{name}_demo", f"dqn_{name}"):
            Path(f"data/{stem}.h5").hardlink_to(atari_recording)
    for name in ("robot_arm", "robot_arm_demo"):
        Path(f"data/{name}.h5").hardlink_to(recording)
    return tmp_path


PAPER = "paper/vd4rl/multi_step_inverse"
HAMLET, MMACT = "activities/hamlet", "paper/mmact/hamlet"
EXPLORATION, PAPER_EXPLORATION = "urlb/walker_repdib", "paper/urlb/walker"
ATARI, PAPER_ATARI = "atari", "paper/atari/breakout"
GAMES = ("pong", "qbert", "seaquest")
BASES = (
    *("robot_arm", "mazes", "control", "factors", HAMLET, f"{HAMLET}_repdib", PAPER, MMACT),
    *(EXPLORATION, PAPER_EXPLORATION, ATARI, PAPER_ATARI),
)
"""Configurations of a whole run; the others are laid over one of them."""

OVERLAYS = [name for name in packaged() if name not in BASES]
ANYWHERE = [name for name in OVERLAYS if name.startswith(("bottleneck/", "objective/"))]
ANYWHERE_DRAWN = [f"bottleneck/{name}" for name in ("none", "vib", "vq", "repdib", "svib")]
"""What fits pictures without actions."""

LAYERS = [
    *([base] for base in BASES),
    *(["robot_arm", name] for name in [*ANYWHERE, "debug", "demo"]),
    *(["mazes", name] for name in ANYWHERE),
    *(["control", name] for name in [*ANYWHERE, "demo_control"]),
    *(["factors", name] for name in [*ANYWHERE_DRAWN, "factors_grid"]),
    ["factors", "paper/pacs"],
    *([PAPER, name] for name in OVERLAYS if name.startswith("paper/vd4rl/")),
    [HAMLET, "activities/keyless", "activities/repdib_fusion"],
    [HAMLET, "activities/repdib_both", "activities/weighting", "activities/sessions"],
    [HAMLET, "activities/smartwatch", "activities/smartwatch_sides", "debug"],
    [HAMLET, "activities/smartwatch", "activities/statistics"],
    [MMACT, f"{MMACT}_repdib"],
    *([EXPLORATION, f"bottleneck/{name}"] for name in ("none", "vq")),
    *([EXPLORATION, f"urlb/{domain}"] for domain in ("quadruped", "jaco")),
    *([PAPER_EXPLORATION, f"paper/urlb/{domain}"] for domain in ("quadruped", "jaco")),
    *([ATARI, name] for name in ("bottleneck/none", "bottleneck/vib", "bottleneck/vq", "demo_atari")),
    *([ATARI, f"atari/{game}"] for game in GAMES),
    *([PAPER_ATARI, f"paper/atari/{game}"] for game in GAMES),
]
FEW_FRAMES = ["--data.frames", "5000", "--data.seed_frames", "1000", "--data.snapshots", "[]",
              "--data.action_repeat", "25", "--data.image_size", "32", "--data.processes", "false",
              "--data.environments", "2"]  # fmt: skip
EXPLORED_AT_ONCE = ["--data.frames", "20500", "--data.snapshots", "[20000]", "--data.action_repeat", "125",
                    "--data.image_size", "32", "--data.batch_size", "4", "--data.processes", "false",
                    "--data.seed_frames", "19000"]  # fmt: skip
SMALL_DT = ["--layers", "1", "--heads", "1", "--width", "8", "--batch_size", "8", "--episodes", "2", "--film", "1",
            "--steps_per_epoch", "2"]  # fmt: skip
ON_A_CPU = ["--trainer.accelerator", "cpu", "--trainer.precision", "32-true"]


@pytest.mark.parametrize("layers", LAYERS, ids="+".join)
def test_every_configuration_trains(here, layers):
    configurations = [argument for name in layers for argument in ("--config", name)]
    small = [*SMALL, *FEW_FRAMES] if "urlb/" in layers[0] else SMALL
    small = [*small, "--data.workers", "0"] if layers[0] == PAPER_ATARI else small
    small = [*small, "--data.batch_size", "2"] if "paper/pacs" in layers else small
    assert main(["fit", *configurations, *small, *ON_A_CPU, "--run", "runs/x"]) == 0
    assert Path("runs/x/checkpoints/step-00000003.ckpt").is_file()
    written = {path.name for path in Path("runs/x").iterdir()}
    assert {"config.yaml", "status.json", "metrics.csv", "environment.json", "bundle.json"} <= written


def test_every_configuration_is_in_a_test():
    assert {name for layers in LAYERS for name in layers} == set(packaged())


def test_hamlet_with_repdib_is_hamlet_and_its_overlay(here, capsys):
    asked = []
    for layers in ([f"{HAMLET}_repdib"], [HAMLET, "activities/repdib_both"]):
        with pytest.raises(SystemExit):
            main(["fit", *(word for name in layers for word in ("--config", name)), "--print_config"])
        asked.append(capsys.readouterr().out)
    assert asked[0] == asked[1] and "bottleneck: RepDIB" in asked[0]


def test_a_missing_recording_is_collected_first(here, recording, monkeypatch):
    asked = {}

    def collect(path, **options):
        asked.update(options)
        shutil.copy(recording, path)

    monkeypatch.setattr("repdib_lightning.environments.collect_robot_arm.collect_robot_arm", collect)
    Path("data/robot_arm.h5").unlink()
    assert main(["fit", *SMALL, "--run", "runs/x"]) == 0
    assert asked == {"samples": 14_000, "seed": 0}


def test_a_missing_maze_is_collected_first(here, maze_recording, monkeypatch):
    asked = {}

    def collect(path, **options):
        asked.update(options)
        shutil.copy(maze_recording, path)

    monkeypatch.setattr("repdib_lightning.environments.collect_maze.collect_maze", collect)
    Path("data/gridworld.h5").unlink()
    assert main(["fit", "--config", "mazes", *SMALL, "--run", "runs/x"]) == 0
    assert asked == {"world": "GridWorld", "samples": 10_000, "seed": 0, "distractors": None}


def test_the_mazes_go_through_export_and_probe(here, capsys):
    assert main(["fit", "--config", "mazes", *SMALL, "--run", "runs/x", *QUANTISER_AT_ONCE]) == 0
    assert main(["export", "runs/x"]) == 0
    assert main(["probe", "runs/x/bundle", "data/gridworld.h5"]) == 0
    probed = capsys.readouterr().out
    assert all(factor in probed for factor in ("position", "goal", "time_step"))


def test_the_saved_configuration_is_the_whole_run(here):
    assert main(["fit", *SMALL, *QUANTISER_AT_ONCE, "--run", "runs/a"]) == 0
    assert main(["fit", "--config", "runs/a/config.yaml", "--run", "runs/b"]) == 0
    assert Path("runs/a/config.yaml").read_text() == Path("runs/b/config.yaml").read_text()
    assert Path("runs/a/metrics.csv").read_text() == Path("runs/b/metrics.csv").read_text()


def readme_commands() -> list[list[str]]:
    """Arguments of every ``python -m repdib_lightning`` line in the README, in order."""
    text = (ROOT / "README.md").read_text()
    lines = re.findall(r"python -m repdib_lightning ([^`\n]*)", text)
    return [line.split("#")[0].split() for line in lines]


def test_every_command_of_the_readme(here, monkeypatch):
    monkeypatch.setattr(group_drawing, "judge_of", partial(judge_of, steps=20))
    monkeypatch.syspath_prepend(ROOT / "tests/unit/data/importers")
    from test_image_folder import write_csv, write_images
    from vd4rl_files import as_npz, record, write_npz

    for index in range(3):
        write_npz(Path("vd4rl_data/main/walker_walk/expert/64px"), index, as_npz(record(index, rows=12, size=64)))
    rows = 60
    names = write_images(Path("my_recording"), rows=rows, size=(32, 32))
    actions = [i % 5 for i in range(rows)]
    write_csv(Path("my_recording"), {"image": names, "action": actions, "episode": [i // 10 for i in range(rows)]})
    commands = readme_commands()
    assert {command[0] for command in commands} <= set(VERBS) and len(commands) >= 8
    for command in commands:
        small: list[str] = []
        if command[0] == "suite":
            continue  # test_the_suite_of_the_readme, on fewer points
        if command[:2] == ["finetune", "dqn"]:
            small = ["--steps", "60", "--learning_starts", "30", "--evaluate_every", "30"]
        elif command[:2] in (["finetune", "ddpg"], ["finetune", "sac"]):
            small = ["--frames", "3000", "--seed_frames", "1000", "--batch_size", "4", "--episodes", "2"]
        elif command[:2] == ["finetune", "dt"]:
            small = [*SMALL_DT, "--epochs", "1"]
        elif command[0] == "finetune":
            small = ["--steps", "10", "--hidden", "32", "--batch_size", "16", "--episodes", "2", "--film", "1"]
        if command[:2] == ["collect", "control"]:
            small = ["--samples", "200", "--workers", "1"]
        if command[:2] == ["collect", "shapes"]:
            small = ["--samples", "500"]
        if "urlb/walker_repdib" in command:
            small = [*EXPLORED_AT_ONCE, *QUANTISER_AT_ONCE]
        elif command[0] == "fit":
            small = SMALL if "--resume" not in command else ["--trainer.max_steps", "4"]
            if not {"bottleneck/none", "activities/hamlet", "--resume"} & set(command):
                small = [*small, *QUANTISER_AT_ONCE]
            if "activities/hamlet_repdib" in command:
                small = [*small, "--model.encoder.init_args.bottleneck_options.start_step", "1"]
        if "--trainer.devices" in command:
            assert command_in_processes(2, here, *command, *small) == [0, 0], (here / "output.txt").read_text()
        else:
            assert main([*command, *small]) == 0, command


def test_the_python_of_the_readme(here):
    assert main(["fit", *SMALL, *QUANTISER_AT_ONCE, "--run", "runs/demo/repdib"]) == 0
    assert main(["export", "runs/demo/repdib"]) == 0
    (code,) = re.findall(r"```python\n(.*?)```", (ROOT / "README.md").read_text(), flags=re.DOTALL)
    import torch

    names = {view: torch.zeros(2, 3, 64, 64, dtype=torch.uint8) for view in ("front", "top")}
    exec(code, names)
    assert names["latent"].shape == (2, 128) and names["codes"].shape == (2, 8)


def test_the_suite_of_the_readme(here, capsys):
    """The packaged suite, cut down to two points of three steps: run, status, report."""
    commands = suite_commands("robot_arm")
    plan = yaml.safe_load(packaged_suites()["robot_arm"].read_text())
    steps = {"config": "steps.yaml", "trainer.max_steps": 3, "trainer.val_check_interval": 2}
    steps["trainer.log_every_n_steps"] = 1
    plan["grids"] = {"bottleneck": {"with": steps, "vary": {"config": ["bottleneck/none", "bottleneck/repdib"]}}}
    at_once = {"class_path": "RepDIB", "init_args": {"start_step": 1}}
    Path("steps.yaml").write_text(yaml.safe_dump({"data": {"batch_size": 8}, "model": {"bottleneck": at_once}}))
    plan |= {"seeds": [0], "claims": {text: c for text, c in plan["claims"].items() if c["setting"] == "repdib"}}
    for row in plan["headline"].values():
        row["paper"].pop("vq")
    Path("robot_arm.yaml").write_text(yaml.safe_dump(plan))
    for command in commands:
        assert main([*command[:2], "robot_arm.yaml"]) == 0
        assert "2 finished of 2" in capsys.readouterr().out or command[1] == "report"
    written = {path.name for path in Path("results/robot_arm").iterdir()}
    assert {"report.md", "report.html", "latents.png", "drawn.png", "bottleneck-codebooks.png"} <= written


def suite_commands(name: str) -> list[list[str]]:
    """What the README says of a suite."""
    commands = [command for command in readme_commands() if command[0] == "suite" and command[2] == name]
    assert [command[1] for command in commands] == ["run", "status", "report"]
    return commands


def test_the_suite_of_the_mazes(here, capsys):
    """The packaged suite with every fine-tuning, on two points, few steps and one seed."""
    plan = yaml.safe_load(packaged_suites()["mazes"].read_text())
    small = {"steps": 60, "learning_starts": 30, "evaluate_every": 30}
    for run in plan["finetune"]["runs"].values():
        run |= small
    Path("steps.yaml").write_text(
        yaml.safe_dump(
            {
                "data": {"batch_size": 8},
                "trainer": {"max_steps": 3, "val_check_interval": 2, "log_every_n_steps": 1},
                "model": {"bottleneck": {"class_path": "RepDIB", "init_args": {"start_step": 1, "groups": 16}}},
            }
        )
    )
    settings = {"dqn": {"pretrained": False}, "repdib_16": {"config": "steps.yaml"}}
    plan["grids"] = {"mazes": {"baseline": "dqn", "settings": settings}}
    plan["claims"] = {
        text: claim
        for text, claim in plan["claims"].items()
        if claim["setting"] == "repdib_16" and claim.get("grid", "mazes") == "mazes" and "noise" not in text
    }
    plan |= {"seeds": [0], "show": ["repdib_16"]}
    Path("mazes.yaml").write_text(yaml.safe_dump(plan))
    for command in suite_commands("mazes"):
        assert main([*command[:2], "mazes.yaml"]) == 0
        assert "2 finished of 2" in capsys.readouterr().out or command[1] == "report"
    written = {path.name for path in Path("results/mazes").iterdir()}
    figures = {"mazes-learning-eval-success.png", "mazes-coverage.png", "mazes-topology.png", "latents.png"}
    assert {"report.md", "report.html", "maps.json", "curves.csv", *figures} <= written


def test_the_suite_of_offline_control(here, capsys):
    """The packaged suite, cut down to one point of few steps."""
    plan = yaml.safe_load(packaged_suites()["control"].read_text())
    plan["finetune"]["with"] = {"steps": 10, "hidden": 32, "batch_size": 16, "episodes": 2, "film": 1}
    steps = {"trainer.max_steps": 3, "trainer.val_check_interval": 2, "data.batch_size": 8}
    at_once = {"model.bottleneck.init_args.start_step": 1, "trainer.log_every_n_steps": 1}
    probe = plan["grids"]["headline"]["probe"]
    plan["grids"] = {"headline": {"probe": probe, "settings": {"repdib": {**steps, **at_once}}}}
    plan |= {"seeds": [0], "claims": {}, "films": ["headline/repdib"], "show": ["repdib"]}
    Path("control.yaml").write_text(yaml.safe_dump(plan))
    for command in suite_commands("control"):
        assert main([*command[:2], "control.yaml"]) == 0
        assert "1 finished of 1" in capsys.readouterr().out or command[1] == "report"
    written = {path.name for path in Path("results/control").iterdir()}
    figures = {"films.png", "film-headline-repdib-walker_walk.mp4", "drawn.png", "headline-learning-eval-return.png"}
    assert {"report.md", "report.html", "curves.csv", *figures} <= written


def test_the_suite_of_activities(here, capsys):
    """The packaged suite, cut down to one point of few steps."""
    plan = yaml.safe_load(packaged_suites()["activities"].read_text())
    steps = {"trainer.max_steps": 3, "trainer.val_check_interval": 2, "data.batch_size": 8}
    steps |= {"trainer.log_every_n_steps": 1}
    at_once = {"model.bottleneck.init_args.start_step": 1, "model.encoder.init_args.bottleneck_options.start_step": 1}
    hamlet = {"config": "activities/repdib_both", **steps, **at_once}
    plan["grids"] = {"subjects": {"settings": {"hamlet": hamlet}}}
    row = plan["headline"]["unseen people"]
    plan["headline"] = {"unseen people": {**row, "paper": {"hamlet": row["paper"]["hamlet"]}}}
    plan |= {"seeds": [0], "claims": {}, "recognised": ["subjects/hamlet"]}
    Path("activities.yaml").write_text(yaml.safe_dump(plan))
    for command in suite_commands("activities"):
        assert main([*command[:2], "activities.yaml"]) == 0
        assert "1 finished of 1" in capsys.readouterr().out or command[1] == "report"
    written = {path.name for path in Path("results/activities").iterdir()}
    drawn = {f"recognised-subjects-hamlet-{name}.png" for name in ("confusion", "modalities", "clips")}
    assert {"report.md", "report.html", "overview-recognition-f1_macro.png", *drawn} <= written
    text = Path("results/activities/report.md").read_text()
    assert "| unseen people: here |" in text and "| recognition/perplexity/fused |" in text


def test_the_suite_of_exploration(here, capsys):
    """The packaged suite with one bottleneck and one snapshot, few actions and one seed."""
    plan = yaml.safe_load(packaged_suites()["urlb"].read_text())
    words = [*EXPLORED_AT_ONCE, *QUANTISER_AT_ONCE]
    small = {key.removeprefix("--"): yaml.safe_load(value) for key, value in zip(words[::2], words[1::2], strict=True)}
    small |= {"data.image_size": 64, "trainer.log_every_n_steps": 1}
    small |= {"data.frames": 6000, "data.snapshots": [5000], "data.seed_frames": 4000, "data.hold_out_every": 3}
    few = {"frames": 3000, "seed_frames": 1000, "batch_size": 4, "episodes": 2, "evaluate_every": 1000, "hidden": 8}
    for each in (plan["finetune"], plan["grids"]["trained_along"]["finetune"]):
        each["with"] |= few
        each["snapshots"] = [5000]
    for grid in plan["grids"].values():
        grid |= {"baseline": "scratch", "settings": {"repdib": small, "scratch": {"pretrained": False}}}
    del plan["finetune"]["runs"]["walker_run"]
    told = [text for text in plan["claims"] if "RepDIB" in text and "none at all on walker-walk" in text]
    plan["claims"] = {text: plan["claims"][text] for text in told}
    plan["measures"] = ["explore/coverage", "ddpg/walker_walk/return"]
    plan |= {"seeds": [0], "data": "data/walker_walk_demo.h5", "collect": None}
    Path("urlb.yaml").write_text(yaml.safe_dump(plan))
    for command in suite_commands("urlb"):
        assert main([*command[:2], "urlb.yaml"]) == 0
        assert "3 finished of 3" in capsys.readouterr().out or command[1] == "report"
    written = {path.name for path in Path("results/urlb").iterdir()}
    figures = {f"{grid}-snapshots-walker_walk-eval-return.png" for grid in plan["grids"]}
    assert {"report.md", "report.html", "walker-curves.png", "walker-values-walker_walk.png", *figures} <= written


def test_the_suite_of_atari(here, capsys):
    """The packaged suite with two numbers of groups, few steps and one seed."""
    plan = yaml.safe_load(packaged_suites()["atari"].read_text())
    few = {
        key.removeprefix("--"): yaml.safe_load(value) for key, value in zip(SMALL_DT[::2], SMALL_DT[1::2], strict=True)
    }
    plan["finetune"]["with"] = {**few, "epochs": 1}
    words = [*SMALL, *QUANTISER_AT_ONCE, "--trainer.log_every_n_steps", "1"]
    small = {key.removeprefix("--"): yaml.safe_load(value) for key, value in zip(words[::2], words[1::2], strict=True)}
    small.pop("trainer.enable_progress_bar")
    fewer = {**small, "model.bottleneck.init_args.groups": 4}
    plan["grids"] = {
        "breakout": {"settings": {"repdib": small}},
        "groups": {"settings": {"groups_4": fewer, "repdib": small}},
    }
    plan["headline"] = {"Breakout": {"grid": "breakout", "measure": "dt/game/return", "paper": {"repdib": 41.8}}}
    plan["claims"] = {text: claim for text, claim in plan["claims"].items() if claim.get("grid") == "groups"}
    plan |= {"seeds": [0], "collect": None, "probe_collect": None, "films": ["breakout/repdib"]}
    Path("atari.yaml").write_text(yaml.safe_dump(plan))
    for command in suite_commands("atari"):
        assert main([*command[:2], "atari.yaml"]) == 0
        assert "2 finished of 2" in capsys.readouterr().out or command[1] == "report"
    written = {path.name for path in Path("results/atari").iterdir()}
    figures = {"against-groups.png", "overview-dt-game-normalised.png", "film-breakout-repdib-game.mp4"}
    assert {"report.md", "report.html", "films.png", *figures} <= written


@pytest.mark.parametrize("name", packaged_suites())
def test_every_setting_of_every_suite_is_an_option_of_fit(here, name, capsys):
    alike = {(s.configs, tuple(s.options)): s for s in read_suite(name).settings if s.pretrained}
    for setting in alike.values():
        with pytest.raises(SystemExit) as ending:
            main(["fit", *setting.arguments(0), "--print_config"])
        assert ending.value.code == 0, setting.place
    assert "seed_everything" in capsys.readouterr().out


@pytest.mark.parametrize("name", sorted(path.name for path in (ROOT / "results").glob("*/points.jsonl")))
def test_results_name_no_place_of_a_machine(name):
    for path in (ROOT / "results").glob(f"*/{name}"):
        assert not re.search(r"/(home|root|work|tmp|Users)/", path.read_text()), path


def test_the_tables_of_the_readme_are_those_of_the_results():
    """Every row below the link to a report stands in that report."""
    text = (ROOT / "README.md").read_text()
    linked = re.findall(r"\]\((results/\w+/report\.md)\)(.*?)(?=\n## |\Z)", text, flags=re.DOTALL)
    assert linked
    for report, section in linked:
        reported = (ROOT / report).read_text().splitlines()
        rows = [line for line in section.splitlines() if line.startswith("|")]
        assert rows and [row for row in rows if row not in reported] == []


def test_make_targets_of_the_readme_exist():
    for target in re.findall(r"make ([a-z-]+)", (ROOT / "README.md").read_text()):
        dry = subprocess.run(["make", "-n", target], cwd=ROOT, capture_output=True, text=True, check=False)
        assert dry.returncode == 0, dry.stderr


def test_help_is_quick_and_names_the_default_run():
    """CPU seconds of ``--help`` in a fresh interpreter: below half a second, however busy the machine is."""
    timer = "import resource, sys; from repdib_lightning.__main__ import main; main(['--help']);"
    timer += "usage = resource.getrusage(resource.RUSAGE_SELF); print(usage.ru_utime + usage.ru_stime)"
    result = subprocess.run([sys.executable, "-c", timer], capture_output=True, text=True, check=True)
    assert all(verb in result.stdout for verb in VERBS)
    assert float(result.stdout.splitlines()[-1]) < 0.5


def test_fit_help_opens_with_the_default_run(capsys):
    with pytest.raises(SystemExit) as ending:
        main(["fit", "--help"])
    opening = " ".join(capsys.readouterr().out.split())[:400]
    assert ending.value.code == 0
    assert "the default run: the simulated robot arm" in opening


def test_every_package_is_installed():
    """Packages are listed by hand in pyproject.toml, because conf/ is one of them."""
    listed = set(tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["setuptools"]["packages"])
    found = {".".join(p.parent.relative_to(ROOT).parts) for p in (ROOT / "repdib_lightning").rglob("__init__.py")}
    assert listed == found | {"repdib_lightning.conf"}
