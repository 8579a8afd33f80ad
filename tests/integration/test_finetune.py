"""``finetune dqn`` from the command line: pre-trained on a tiny maze, fine-tuned, frozen and from scratch."""

from __future__ import annotations

import csv
import json
import math
import multiprocessing
import os
import shutil
import signal
import sys
from pathlib import Path

import numpy as np
import pytest

from repdib_lightning.__main__ import main
from repdib_lightning.encoders import ConvolutionalEncoder
from repdib_lightning.export import load_encoder

PIXELS = ["--env_options.cell_pixels", "3"]
TINY = [*PIXELS, "--env_options.episode_length", "15", "--steps", "30", "--learning_starts", "10", "--batch_size", "8",
        "--evaluate_every", "12", "--hidden", "16", "--device", "cpu"]  # fmt: skip
FRESH = ["--features", "8", "--channels", "2"]
MAZE_MEASURES = {
    "return", "moves", "mean_return", "success", "solved", "mean_success", "final_success", "steps_to_solve",
    "coverage", "entropy", "mean_coverage", "topology", "topology_pairs", "straight_line", "straight_line_pairs",
}  # fmt: skip


@pytest.fixture(scope="module")
def pretrained(tmp_path_factory):
    """A run of DRIML with RepDIB on a few frames of GridWorld, exported."""
    folder = tmp_path_factory.mktemp("pretrained")
    store, run = str(folder / "maze.h5"), str(folder / "run")
    assert main(["collect", "maze", store, "--samples", "200", "--cell_pixels", "3", "--episode_length", "20",
                 "--progress", "false"]) == 0  # fmt: skip
    assert main(["fit", "--config", "mazes", "--data.path", store, "--data.batch_size", "16", "--trainer.max_steps",
                 "6", "--trainer.val_check_interval", "3", "--trainer.enable_progress_bar", "false", "--run", run,
                 "--model.encoder.init_args.features", "16", "--model.encoder.init_args.channels", "4",
                 "--model.bottleneck.init_args.groups", "4", "--model.bottleneck.init_args.codes", "6",
                 "--model.bottleneck.init_args.start_step", "1", "--trainer.accelerator", "cpu"]) == 0  # fmt: skip
    assert main(["export", run]) == 0
    return folder / "run"


@pytest.fixture
def here(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return tmp_path


def finetune(*options: str) -> int:
    return main(["finetune", "dqn", *options])


def rows(run: str) -> list[dict[str, str]]:
    with open(Path(run, "progress.csv"), newline="") as file:
        return list(csv.DictReader(file))


def outcome(run: str) -> dict:
    return json.loads(Path(run, "outcome.json").read_text())


def names(folder: str) -> set[str]:
    return {path.name for path in Path(folder).iterdir() if not path.name.startswith("events.")}


@pytest.mark.parametrize("world", ["GridWorld", "SpiralWorld", "LoopWorld"])
def test_fine_tuned_in_every_maze(pretrained, here, capsys, world):
    assert finetune("--env", world, "--encoder", str(pretrained), "--run", "r", *TINY) == 0
    said = capsys.readouterr().out
    assert said.startswith(f"{world}, reaches the goal from") and said.endswith("wrote r\n")

    assert names("r") == {"bundle", "finetune.json", "outcome.json", "policy.zip", "progress.csv"}
    table = rows("r")
    assert [int(row["step"]) for row in table] == [12, 24, 30]
    assert list(table[0])[:7] == ["step", "eval/return", "eval/success", "eval/moves", "train/exploration",
                                  "train/coverage", "train/entropy"]  # fmt: skip
    last = {name: float(value) for name, value in table[-1].items()}
    assert {"train/loss", "train/kl", "train/commitment", "train/perplexity"} <= set(last)
    assert all(map(math.isfinite, last.values())) and 0 < last["train/coverage"] <= 1
    assert last["train/exploration"] == 0.05

    found = outcome("r")
    assert set(found) == {"agent", "environment", "versions", "configuration", "measures", "maps"}
    assert found["agent"] == "dqn" and found["environment"] == world
    assert found["versions"]["stable_baselines3"] and found["configuration"]["steps"] == 30
    assert set(found["measures"]) == MAZE_MEASURES and all(map(math.isfinite, found["measures"].values()))
    assert found["measures"]["mean_return"] == pytest.approx(np.mean([float(r["eval/return"]) for r in table]), 1e-4)
    assert {name: np.shape(values) for name, values in found["maps"].items()} == dict.fromkeys(
        ("visits", "latent_distance", "path_length"), (6, 6)
    )
    # Each step and each reset is a visit: one more for every episode that ended, and the first.
    assert 31 <= np.sum(found["maps"]["visits"]) <= 31 + 30
    assert np.mean(np.array(found["maps"]["visits"]) > 0) == pytest.approx(found["measures"]["coverage"])

    before, after = load_encoder(pretrained / "bundle"), load_encoder("r/bundle")
    picture = np.random.default_rng(0).integers(0, 256, (5, 3, 18, 18), dtype=np.uint8)
    assert after.encode(picture).shape == (5, 16) and after.codes(picture).shape == (5, 4)
    assert not np.allclose(before.encode(picture), after.encode(picture))


def test_frozen_amid_distractors(pretrained, here):
    noisy = ["--env_options.distractors", "procedural"]
    bundle = str(pretrained / "bundle")
    before = (pretrained / "bundle" / "model.safetensors").read_bytes()
    assert finetune("--env", "LoopWorld", "--encoder", bundle, "--frozen", "--run", "r", *TINY, *noisy) == 0
    assert names("r") == {"finetune.json", "outcome.json", "policy.zip", "progress.csv"}
    assert (pretrained / "bundle" / "model.safetensors").read_bytes() == before
    assert set(outcome("r")["measures"]) == MAZE_MEASURES
    assert not any(name.startswith("train/kl") for name in rows("r")[-1])


def test_from_scratch_amid_distractors_without_a_goal(here, capsys):
    free = ["--env_options.distractors", "procedural", "--env_options.goals", "none", "--env_options.start", "0,0"]
    assert finetune("--env", "SpiralWorld", "--run", "r", *TINY, *FRESH, *free) == 0
    assert "was in" in capsys.readouterr().out
    found = outcome("r")
    assert set(found["measures"]) == {name for name in MAZE_MEASURES if name[:4] in ("cove", "entr", "topo", "stra")
                                      or name == "mean_coverage"}  # fmt: skip
    assert found["maps"]["visits"][0][0] >= 3  # the first cell of each of the episodes of 15 steps
    assert np.sum(found["maps"]["visits"]) == 30 + 3 and "eval/return" not in rows("r")[0]
    assert load_encoder("r/bundle").features == 8


@pytest.mark.parametrize("frozen", [[], ["--frozen"]])
def test_a_seed_decides_everything(pretrained, here, frozen):
    bundle = ["--encoder", str(pretrained), "--env_options.distractors", "procedural", *frozen]
    for run, seed in (("a", "0"), ("b", "0"), ("c", "1")):
        assert finetune("--env", "SpiralWorld", "--run", run, "--seed", seed, *TINY, *bundle) == 0
    for name in ("progress.csv", "outcome.json", "finetune.json"):
        assert Path("a", name).read_bytes() == Path("b", name).read_bytes()
    assert Path("a/progress.csv").read_bytes() != Path("c/progress.csv").read_bytes()
    assert outcome("a")["maps"]["visits"] != outcome("c")["maps"]["visits"]
    if not frozen:
        weights = [Path(run, "bundle/model.safetensors").read_bytes() for run in "abc"]
        assert weights[0] == weights[1] != weights[2]


def test_the_robot_arm_from_scratch(here, monkeypatch):
    monkeypatch.setenv("MUJOCO_GL", os.environ.get("MUJOCO_GL", "egl"))
    options = ["--env_options.goal", "3", "--env_options.image_size", "20", "--env_options.episode_length", "4"]
    few = ["--steps", "8", "--learning_starts", "4", "--batch_size", "4", "--buffer_size", "20", "--device", "cpu"]
    assert finetune("--env", "RobotArm", "--run", "r", *options, *few, *FRESH) == 0
    found = outcome("r")
    assert set(found["measures"]) == {"return", "moves", "mean_return"} and found["maps"] == {}
    assert -4 <= found["measures"]["return"] <= 0 and 1 <= found["measures"]["moves"] <= 4
    encoder = load_encoder("r/bundle")
    assert set(encoder.spec.observations) == {"front", "top"} and type(encoder.encoder) is ConvolutionalEncoder


def complaint(capsys, *arguments: str) -> str:
    """Run a command that must fail; return its one line. Nothing may be left behind."""
    capsys.readouterr()
    before = sorted(Path().rglob("*"))
    assert finetune(*arguments) == 2
    error = capsys.readouterr().err.strip().splitlines()
    assert len(error) == 1 and error[0].startswith("error: "), error
    assert sorted(Path().rglob("*")) == before, "something was left behind"
    return error[0]


@pytest.mark.parametrize(
    ("options", "wanted"),
    [
        (["--env", "SpiralWrld"], "--env SpiralWrld: no such environment, did you mean 'SpiralWorld'?"),
        (["--env", "CartPole-v1"], "gives no picture (uint8, height x width x channels) but Box("),
        (["--env", "Pendulum-v1"], "--env Pendulum-v1: DQN needs discrete actions, these are Box("),
        (["--env_options.sze", "5"], "--env_options.sze: no option of GridWorld, did you mean 'size'?"),
        (["--env_options.world", "LoopWorld"], "--env_options.world: no option of GridWorld"),
        (["--env_options.max_episode_steps", "5"], "max_episode_steps: no option of GridWorld, did you mean 'episode_"),
        (
            ["--env", "RobotArm", "--env_options.gaol", "3"],
            "--env_options.gaol: no option of RobotArm, did you mean 'g",
        ),
        (["--env_options.size", "abc"], "--env_options.size: expected int, got 'abc'"),
        (["--env_options.size", "4.5"], "--env_options.size: expected int, got '4.5'"),
        (["--env_options.show_walls", "2"], "--env_options.show_walls: expected bool, got '2'"),
        (["--env_options.distractors", "3"], "--env_options.distractors: expected str, got '3'"),
        (["--env_options.distractors", "nowhere"], "distractors: 'nowhere' is neither built in nor a folder"),
        (["--env_options.size", "3"], "size=3: a maze has 4 to 32 cells"),
        (["--env_options.goals", "6,2"], "goals=6,2: lies outside of GridWorld"),
        (["--env_options.goals", "2.5,2"], "goals=2.5,2: lies in a wall between the cells of GridWorld"),
        (["--env_options", "5"], "env_options"),
        (
            ["--encoder", "nowhere"],
            "--encoder nowhere: no such bundle; export one: python -m repdib_lightning export RUN",
        ),
        (["--frozen"], "--frozen needs --encoder BUNDLE"),
        (["--run", "taken"], "--run taken: exists already; choose another folder or pass --overwrite"),
        (["--run", "taken", "--overwrite"], "--run taken: is no run of finetune, so --overwrite does not replace it"),
        (["--run", "taken/file/r"], "--run taken/file/r: cannot be made (Not a directory)"),
        (["--steps", "0"], "--steps must be at least 1, is 0"),
        (["--steps", "many"], "steps: expected int, got 'many'"),
        (["--stepss", "5"], "unknown option --stepss, did you mean '--steps'?"),
        (["--learning_starts", "5000"], "--learning_starts 5000: must be below --steps 5000"),
        (["--gamma", "1.01"], "--gamma must be in [0, 1], is 1.01"),
        (["--tau", "0"], "--tau must be above 0"),
        (["--exploration_fraction", "0"], "--exploration_fraction must be above 0"),
        (["--learning_rate", "0"], "--learning_rate must be above 0, is 0.0"),
        (["--bottleneck_losses", "-1"], "--bottleneck_losses must not be negative, is -1.0"),
        (["--seed", "-1"], "--seed must not be negative, is -1"),
        (["--seed", "4294967296"], "--seed must be below 4294967296"),
        (["--n_steps", "3"], "--n_steps 3: Stable-Baselines3 keeps longer returns with --frozen only"),
        (["--features", "0"], "features must be at least 1, is 0"),
        (["--strides", "[9,9,9]"], "30x30 pixels is too small for strides"),
        (
            ["--features", "64", "--encoder", "x"],
            "--features: is of a fresh encoder, --encoder x has its own; leave it",
        ),
        (["--strides", "[2]", "--encoder", "x"], "--strides: is of a fresh encoder, --encoder x has its own; leave it"),
        (["--buffer_size", "100"], "--buffer_size 100: must hold a batch, --batch_size is 128"),
        (["--encoder", "taken"], "--encoder taken: holds no bundle; export one: python -m repdib_lightning export RUN"),
        (["--encoder", "taken/file"], "--encoder taken/file: is a file, a bundle is a folder; export one: python"),
        (["--frozen", "maybe"], "frozen: expected bool, got 'maybe'"),
        (["--device", "gpu"], "--device gpu: there is no such device, did you mean 'cpu'? (choices: auto, cpu, cuda)"),
        (["--device", "cuda:x"], "--device cuda:x: there is no such device, did you mean 'cuda'?"),
        (["--device", "cuda:99"], "--device 'cuda:99' cannot be used here, "),
        (["--buffer_size", "1000000000000"], "--buffer_size 1000000000000: does not fit into memory"),
    ],
)
def test_bad_input_is_one_line_and_leaves_nothing(here, capsys, options, wanted):
    Path("taken").mkdir()
    Path("taken/file").write_text("mine")
    run = [] if "--run" in options else ["--run", "r"]
    assert wanted in complaint(capsys, *options, *run)


def test_a_bundle_of_other_pictures_names_both_shapes(pretrained, here, capsys):
    for frozen in ([], ["--frozen"]):
        said = complaint(capsys, "--encoder", str(pretrained), "--run", "r", *frozen)
        assert f"--encoder {pretrained}: does not fit GridWorld: " in said
        assert "(3, 30, 30)" in said and "(3, 18, 18)" in said


def test_a_run_that_was_not_exported_says_how(here, capsys):
    Path("r/checkpoints").mkdir(parents=True)
    said = complaint(capsys, "--encoder", "r", "--run", "mine")
    assert said.endswith("--encoder r: holds no bundle; export one: python -m repdib_lightning export r")


def test_what_a_fresh_encoder_is_made_of_is_recorded(pretrained, here):
    assert finetune("--run", "fresh", *TINY, "--features", "8") == 0
    used = outcome("fresh")["configuration"]
    assert (used["features"], used["channels"], used["strides"]) == (8, 16, [3, 2])
    assert used == json.loads(Path("fresh/finetune.json").read_text())
    assert load_encoder("fresh/bundle").features == 8
    assert finetune("--run", "given", "--encoder", str(pretrained), *TINY) == 0
    assert outcome("given")["configuration"]["features"] is None


def test_without_stable_baselines3(here, capsys, monkeypatch):
    monkeypatch.setitem(sys.modules, "stable_baselines3", None)
    assert "finetune needs Stable-Baselines3: pip install" in complaint(capsys, "--run", "r")


def test_a_run_is_replaced_only_when_asked(here, capsys):
    assert finetune("--run", "r", *TINY, *FRESH) == 0
    before = Path("r/progress.csv").read_bytes()
    Path("r/old").touch()
    assert "exists already" in complaint(capsys, "--run", "r", *TINY, *FRESH)
    # A command that cannot work leaves the earlier run alone.
    complaint(capsys, "--run", "r", "--overwrite", "--env", "SpiralWrld")
    assert Path("r/progress.csv").read_bytes() == before
    assert finetune("--run", "r", "--overwrite", *TINY, *FRESH, "--seed", "1") == 0
    assert not Path("r/old").exists() and Path("r/progress.csv").read_bytes() != before


def _killed_at(step: int, arguments: list[str]) -> None:
    from repdib_lightning.rl.visits import CountVisits

    walk, taken = CountVisits.step, []

    def walk_and_die(self, action):
        taken.append(action)
        if len(taken) == step:
            os.kill(os.getpid(), signal.SIGKILL)
        return walk(self, action)

    CountVisits.step = walk_and_die
    main(arguments)


def test_a_killed_run_has_no_outcome_and_can_be_made_again(here):
    arguments = ["finetune", "dqn", "--run", "r", *TINY, *FRESH]
    child = multiprocessing.get_context("fork").Process(target=_killed_at, args=(20, arguments))
    child.start()
    child.join()
    assert child.exitcode == -signal.SIGKILL
    assert "outcome.json" not in names("r") and len(rows("r")) == 1
    assert main([*arguments, "--overwrite"]) == 0
    assert outcome("r")["configuration"]["steps"] == 30 and len(rows("r")) == 3


def test_it_runs_without_the_bundle_that_it_came_from(pretrained, here):
    shutil.copytree(pretrained / "bundle", "mine")
    assert finetune("--encoder", "mine", "--run", "r", *TINY) == 0
    shutil.rmtree("mine")
    from repdib_lightning.rl.dqn import BottleneckDQN

    agent = BottleneckDQN.load("r/policy.zip", device="cpu")
    action, _ = agent.predict({"picture": np.zeros((3, 18, 18), np.uint8)}, deterministic=True)
    assert 0 <= int(action) < 4
