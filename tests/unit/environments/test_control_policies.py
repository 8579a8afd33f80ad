"""Behaviour policies: files whole and of this task, networks of several ages, training that leaves no trace."""

from __future__ import annotations

import os
import shlex
import stat
import sys
from pathlib import Path

import numpy as np
import pytest
from safetensors.numpy import save_file
from small_policies import NAMES, random_network, write_small

from repdib_lightning.__main__ import main
from repdib_lightning.environments import train_policies as training
from repdib_lightning.environments.behaviour_policy import Network, packaged_policy, read_policies, write_policies
from repdib_lightning.environments.control_state_env import ControlStateEnv
from repdib_lightning.environments.control_task import ControlTask
from repdib_lightning.environments.train_policies import choose, mean_return, train_policies
from repdib_lightning.errors import UserError
from repdib_lightning.verbs import parse

WALKER = {"task": "walker-walk", "action_repeat": 50, "state": 24, "actions": 6}
QUICK = {"task": "pendulum-swingup", "action_repeat": 20, "hidden": 8, "progress": False}


def test_a_file_gives_back_what_was_written(tmp_path):
    names = (*NAMES, *(f"replay_{age}" for age in range(4, 12)))
    policies = read_policies(write_small(tmp_path / "p.safetensors", names=names), **WALKER)
    assert policies.replay == [f"replay_{age}" for age in range(12)], "in the order of training"
    assert policies.facts["networks"]["expert"] == {"steps": 1, "return": 2.0}
    for index, name in enumerate(names):
        written, read = random_network(index), policies.network(name)
        assert all(map(np.array_equal, written.weights, read.weights))
        assert all(map(np.array_equal, written.biases, read.biases))
    assert os.listdir(tmp_path) == ["p.safetensors"]


def test_the_mode_needs_no_generator_and_draws_repeat():
    network = random_network(0)
    spread = Network(network.weights, (*network.biases[:-1], np.zeros(6, np.float32)))
    state = np.random.default_rng(1).normal(size=24)
    draws = [spread.act(state, np.random.default_rng(seed)) for seed in (3, 3, 4)]
    assert np.array_equal(draws[0], draws[1]) and not np.array_equal(draws[0], draws[2])
    assert all(draw.dtype == np.float32 and np.abs(draw).max() <= 1 for draw in draws)
    assert np.array_equal(spread.act(state, None), network.act(state, None))
    many = np.arctanh([spread.act(state, np.random.default_rng(seed))[0] for seed in range(300)])
    assert np.std(many) == pytest.approx(1, abs=0.15)
    assert np.mean(many) == pytest.approx(np.arctanh(network.act(state, None)[0]), abs=0.2)


def test_other_users_may_read_what_the_umask_lets_them(tmp_path):
    before = os.umask(0o027)
    try:
        path = write_small(tmp_path / "p.safetensors")
    finally:
        os.umask(before)
    assert stat.S_IMODE(path.stat().st_mode) == 0o640


def damaged(folder: Path) -> dict[str, Path]:
    """Files that are no policies, each in its way."""
    network, facts = random_network(0), {"task": "walker-walk", "action_repeat": 50, "networks": {"expert": {}}}
    weights, biases = network.weights, network.biases
    twisted = Network((weights[0], weights[1].T[:, :3], *weights[2:]), biases)
    undefined = Network(weights, (np.full(8, np.nan, np.float32), *biases[1:]))
    for name, kept in {"short": Network(weights[:2], biases[:2]), "twisted": twisted, "nan": undefined}.items():
        write_policies(folder / name, facts, {"expert": kept})
    write_policies(folder / "missing", {**facts, "networks": {"medium": {}}}, {"expert": network})
    save_file({"x": np.zeros(3)}, folder / "other")
    save_file({"x": np.zeros(3)}, folder / "list", {"policies": "[1]"})
    save_file({"x": np.zeros(3)}, folder / "text", {"policies": "{"})
    (folder / "empty").touch()
    whole = write_small(folder / "whole").read_bytes()
    (folder / "half").write_bytes(whole[: len(whole) // 2])
    (folder / "whole").unlink()
    return {path.name: path for path in folder.iterdir()}


def test_files_that_are_no_policies_are_named(tmp_path):
    files = damaged(tmp_path)
    assert len(files) == 9
    for path in files.values():
        with pytest.raises(UserError, match=rf"--policy {path}: not policies of 'collect policies' \(") as caught:
            read_policies(path, **WALKER)
        assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("changed", "said"),
    [
        ({"task": "walker-run"}, r"--policy .*: plays walker-run, the task is walker-walk$"),
        ({"action_repeat": 2}, r"--policy .*: was trained with action_repeat 2, this recording has 50$"),
        ({"state": 17}, r"--policy .*: 'medium' maps 17 to 6, walker-walk needs 24 to 6$"),
        ({"actions": 5}, r"--policy .*: 'medium' maps 24 to 5, walker-walk needs 24 to 6$"),
    ],
)
def test_policies_of_something_else_are_refused(tmp_path, changed, said):
    path = write_small(tmp_path / "p.safetensors", **changed)
    with pytest.raises(UserError, match=said):
        read_policies(path, **WALKER)


def test_what_is_not_there_is_told(tmp_path):
    with pytest.raises(UserError, match=r"--policy .*p.safetensors: no such file"):
        read_policies(tmp_path / "p.safetensors", **WALKER)
    policies = read_policies(write_small(tmp_path / "p.safetensors", names=("expert", "replay_x")), **WALKER)
    with pytest.raises(UserError, match=r"has no network 'expart', did you mean 'expert'\?"):
        policies.network("expart")
    assert policies.replay == []
    with pytest.raises(UserError, match=r"no policies of walker-wlk ship.*did you mean 'walker-walk'\?.*train some: "):
        packaged_policy("walker-wlk")


def test_policies_that_ship_play_their_task():
    path = packaged_policy("walker-walk")
    task = ControlTask("walker-walk")
    state = sum(task.sizes.values())
    policies = read_policies(path, task="walker-walk", action_repeat=2, state=state, actions=task.actions)
    returns = {name: told["return"] for name, told in policies.facts["networks"].items()}
    assert path.stat().st_size < 2**20 and len(policies.replay) == 8
    assert returns["replay_0"] < returns["medium"] < returns["expert"] and returns["expert"] > 700
    assert returns["medium"] == returns["replay_7"] >= returns["expert"] / 2
    task.reset(np.random.default_rng(0))
    random, total = np.random.default_rng(1), 0.0
    for _ in range(150):
        total += task.step(policies.network("expert").act(task.state(), random))[0]
    assert total > 0.5 * returns["expert"] * 150 / 500


@pytest.mark.parametrize(
    ("returns", "expert", "medium", "replayed"),
    [
        ([10, 200, 480, 520, 900, 1000, 950], 5, 3, [0, 0, 1, 1, 2, 2, 3, 3]),
        ([0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14], 14, 7, [0, 1, 2, 3, 4, 5, 6, 7]),
        ([5.0], 0, 0, [0] * 8),
        ([800, 900], 1, 0, [0] * 8),
    ],
)
def test_which_networks_are_kept(returns, expert, medium, replayed):
    chosen = choose(returns)
    assert (chosen.pop("expert"), chosen.pop("medium")) == (expert, medium)
    assert list(chosen) == [f"replay_{i}" for i in range(8)]
    assert np.abs(np.array(list(chosen.values())) - replayed).max() <= 1
    assert list(chosen.values()) == sorted(chosen.values()) and chosen["replay_7"] == medium


def test_training_keeps_networks_with_their_returns_and_leaves_nothing_else(tmp_path, monkeypatch):
    pytest.importorskip("stable_baselines3")
    monkeypatch.setenv("SB3_LOGDIR", str(tmp_path / "log"))
    monkeypatch.chdir(tmp_path)
    path = train_policies("p.safetensors", steps=1100, evaluate_every=500, **QUICK)
    assert os.listdir(tmp_path) == ["p.safetensors"]
    policies = read_policies(path, task="pendulum-swingup", action_repeat=20, state=3, actions=1)
    told = policies.facts["networks"]
    assert {entry["steps"] for entry in told.values()} <= {0, 500, 1000, 1100} and told["replay_0"]["steps"] == 0
    for name in ("expert", "medium"):
        again = mean_return(ControlStateEnv("pendulum-swingup", 20), policies.network(name), 100)
        assert again == pytest.approx(told[name]["return"], abs=0.06)
    command = shlex.split(policies.facts["command"])
    assert command[:2] == ["collect", "policies"]
    options = parse("collect policies", train_policies, command[2:])
    assert {key: options[key] for key in ("task", "steps", "action_repeat", "hidden", "seed", "evaluate_every")} == {
        "task": "pendulum-swingup", "steps": 1100, "action_repeat": 20, "hidden": 8, "seed": 100, "evaluate_every": 500
    }  # fmt: skip


def test_training_learns_and_repeats(tmp_path, monkeypatch):
    """Networks change once there is data to learn from, the last of them after the last step."""
    pytest.importorskip("stable_baselines3")
    ages: list[list[Network]] = []

    def noted(environment: ControlStateEnv, network: Network, seed: int) -> float:
        ages[-1].append(network)
        return float(len(ages[-1]))

    monkeypatch.setattr(training, "mean_return", noted)
    for number in range(2):
        ages.append([])
        train_policies(tmp_path / f"{number}.safetensors", steps=1040, evaluate_every=1000, **QUICK)
    first, second = ages
    assert len(first) == 3
    assert np.array_equal(first[0].weights[0], first[1].weights[0]), "1,000 random steps come first"
    assert not np.array_equal(first[1].weights[0], first[2].weights[0])
    assert all(np.array_equal(a, b) for a, b in zip(first[2].weights, second[2].weights, strict=True))
    contents = [(tmp_path / f"{number}.safetensors").read_bytes() for number in range(2)]
    assert contents[0].replace(b"0.safetensors", b"1.safetensors") == contents[1]


def test_an_interruption_leaves_nothing(tmp_path, monkeypatch, capsys):
    pytest.importorskip("stable_baselines3")

    def interrupted(*_: object) -> float:
        raise KeyboardInterrupt

    monkeypatch.setattr(training, "mean_return", interrupted)
    monkeypatch.chdir(tmp_path)
    assert main(["collect", "policies", "p.safetensors", "--task", "pendulum-swingup"]) == 130
    assert "interrupted" in capsys.readouterr().err and not os.listdir(tmp_path)


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["p.h5"], "policies must end in .safetensors, is 'p.h5'"),
        (["taken.safetensors"], "taken.safetensors: exists already; choose another file or pass --overwrite"),
        (["p.safetensors", "--steps", "0"], "steps=0: must be at least 1"),
        (["p.safetensors", "--evaluate_every", "0"], "evaluate_every=0: must be at least 1"),
        (["p.safetensors", "--hidden", "-3"], "hidden=-3: must be at least 1"),
        (["p.safetensors", "--threads", "0"], "threads=0: must be at least 1"),
        (["p.safetensors", "--learning_rate", "0"], "learning_rate=0.0: must be above 0"),
        (["p.safetensors", "--learning_rate", "-1"], "learning_rate=-1.0: must be above 0"),
        (["p.safetensors", "--seed", "-1"], "seed=-1: must be from 0 to"),
        (["p.safetensors", "--action_repeat", "0"], "action_repeat=0: must be at least 1"),
        (["p.safetensors", "--task", "walker-wlk"], "task walker-wlk: unknown, did you mean 'walker-walk'?"),
        (["p.safetensors", "--stps", "3"], "unknown option --stps, did you mean '--steps'?"),
    ],
)
def test_bad_options_are_one_line(tmp_path, monkeypatch, capsys, options, said):
    monkeypatch.chdir(tmp_path)
    Path("taken.safetensors").write_text("mine")
    assert main(["collect", "policies", *options]) == 2
    error = capsys.readouterr().err.splitlines()
    assert len(error) == 1 and said in error[0]
    assert os.listdir() == ["taken.safetensors"] and Path("taken.safetensors").read_text() == "mine"


def test_without_stable_baselines_one_line_says_how_to_get_it(tmp_path, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "stable_baselines3", None)
    monkeypatch.chdir(tmp_path)
    assert main(["collect", "policies", "p.safetensors"]) == 2
    assert "needs Stable-Baselines3: pip install 'repdib_lightning[rl]'" in capsys.readouterr().err
    assert not os.listdir()
