"""Recordings of the Control Suite: the same bytes however made, played by whom they say, amid what they say."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from small_policies import random_network, write_small

from repdib_lightning.__main__ import main
from repdib_lightning.data.episodes import EpisodeStore
from repdib_lightning.data.fingerprint import recompute_fingerprint
from repdib_lightning.environments.behaviour_policy import read_policies
from repdib_lightning.environments.collect_control import ControlRecording, collect_control
from repdib_lightning.environments.control_env import ControlEnv
from repdib_lightning.environments.numbered_clips import NumberedClips
from repdib_lightning.errors import UserError

EPISODES, STEPS = 8, 20
SMALL: dict[str, Any] = {
    "samples": EPISODES * STEPS - 7, "image_size": 16, "action_repeat": 50, "seed": 5, "distractors": "video",
    "progress": False,
}  # fmt: skip


@pytest.fixture(scope="module")
def policy(tmp_path_factory) -> Path:
    return write_small(tmp_path_factory.mktemp("policies") / "small.safetensors")


@pytest.fixture(scope="module")
def path(tmp_path_factory, policy) -> Path:
    return collect_control(tmp_path_factory.mktemp("two") / "x.h5", policy=policy, workers=2, **SMALL)


@pytest.fixture(scope="module")
def store(path) -> EpisodeStore:
    return EpisodeStore(path)


def recording(policy: Path | None = None, **changed: Any) -> ControlRecording:
    """The recording of ``path``, or one with other options; without policies, random actions."""
    behaviour = "random" if policy is None else "medium_expert"
    made = ControlRecording(
        "walker-walk", behaviour, SMALL["samples"], 16, 50, "fast", "video", "sky", "", 5, str(policy or "")
    )
    return replace(made, **changed)


def states(store: EpisodeStore, rows: np.ndarray) -> np.ndarray:
    parts = [
        store.gather(f"factors/{name}", rows).reshape(len(rows), -1) for name in ("orientations", "height", "velocity")
    ]
    return np.concatenate(parts, axis=1)


def test_layout(store, policy):
    assert store.lengths.tolist() == [STEPS + 1] * EPISODES and store.contiguous
    assert {name: (spec.shape, spec.dtype) for name, spec in store.observations.items()} == {
        "pixels": ((3, 16, 16), "uint8")
    }
    assert (store.actions_spec.kind, store.actions_spec.size) == ("continuous", 6)
    kinds = {name: (factor.kind, factor.scale, factor.width, factor.classes) for name, factor in store.factors.items()}
    assert kinds == {
        "orientations": ("endogenous", "continuous", 14, 0),
        "height": ("endogenous", "continuous", 1, 0),
        "velocity": ("endogenous", "continuous", 9, 0),
        "background": ("exogenous", "continuous", 27, 0),
        "clip": ("exogenous", "categorical", 1, 64),
    }
    told = json.loads(store.attributes["configuration"])
    assert (told["task"], told["behaviour"], told["samples"], told["action_repeat"]) == (
        "walker-walk", "medium_expert", 153, 50,
    )  # fmt: skip
    assert told["policy"] == policy.name and len(told["policy_digest"]) == 16
    assert store.attributes["environment"] == "control"


def test_actions_rewards_and_ends(store):
    last = store.starts + store.lengths - 1
    played = np.setdiff1d(np.arange(store.rows), last)
    actions, rewards = store.array("actions"), store.array("rewards")
    assert actions.dtype == np.float32 and np.abs(actions).max() <= 1 and (actions[last] == 0).all()
    assert rewards.dtype == np.float32 and (rewards[played] >= 0).all() and 0 < rewards[played].max() <= 50
    ends = np.array(store.array("truncations"), bool)
    assert np.array_equal(np.flatnonzero(ends), last - 1) and not np.array(store.array("terminations"), bool).any()


def test_an_episode_depends_on_seed_and_number_alone(store, policy):
    record = recording(policy).open()
    for number in (6, 1):
        rows = store.starts[number] + np.arange(STEPS + 1)
        episode = record(number)
        assert np.array_equal(episode["observations"]["pixels"], store.gather("observations/pixels", rows))
        assert np.array_equal(episode["masks"]["pixels"], store.mask("pixels", rows))
        assert np.array_equal(episode["factors"]["background"], store.gather("factors/background", rows))
    other = recording(policy, seed=6).open()(6)
    assert not np.array_equal(other["actions"], episode["actions"])


def test_movements_are_the_same_amid_any_distractors_and_in_both_qualities():
    looks: list[dict[str, Any]] = [
        {}, {"distractors": "none"}, {"distractors": "image"}, {"place": "side"}, {"quality": "paper"}
    ]  # fmt: skip
    short = [replace(recording(), action_repeat=200, **look).open()(3) for look in looks]
    for episode in short[1:]:
        assert np.array_equal(episode["actions"], short[0]["actions"])
        assert np.array_equal(episode["rewards"], short[0]["rewards"])
        for name in ("orientations", "height", "velocity"):
            assert np.array_equal(episode["factors"][name], short[0]["factors"][name])
        assert not np.array_equal(episode["observations"]["pixels"], short[0]["observations"]["pixels"])
    assert set(short[1]["factors"]) == {"orientations", "height", "velocity"}
    assert short[3]["masks"]["pixels"].shape == (6, 16, 24) and not short[3]["masks"]["pixels"][..., 16:].any()
    assert np.array_equal(short[3]["masks"]["pixels"][..., :16], short[1]["masks"]["pixels"])


def test_stored_actions_lead_to_the_stored_states():
    record = replace(recording(), action_repeat=100, distractors="none")
    episode = record.open()(2)
    env = record.environment()
    env.task.reset(np.random.default_rng([5, 2, 0]))
    for step, action in enumerate(episode["actions"]):
        assert np.array_equal(env.task.factors()["orientations"], episode["factors"]["orientations"][step])
        assert np.float32(env.task.step(action)[0]) == episode["rewards"][step]
    assert np.array_equal(env.task.factors()["velocity"], episode["factors"]["velocity"][-1])
    assert np.ptp(episode["actions"]) > 1.5 and episode["actions"].dtype == np.float32
    assert episode["truncations"].tolist() == [False] * 9 + [True]
    env.close()


def test_the_first_half_is_mediums_and_the_second_experts(store):
    """Whoever acts as a network's mode would, nearly without chance, is that network."""
    networks = {"medium": random_network(0), "expert": random_network(1)}
    for number, start in enumerate(store.starts):
        rows = start + np.arange(STEPS)
        actions = store.gather("actions", rows)
        apart = {
            name: np.abs(np.array([network.act(state, None) for state in states(store, rows)]) - actions).max()
            for name, network in networks.items()
        }
        player, other = ("medium", "expert") if number < EPISODES // 2 else ("expert", "medium")
        assert apart[player] < 1e-5 and apart[other] > 0.1


@pytest.mark.parametrize("samples", [8 * STEPS, 40 * STEPS, 200 * STEPS])
def test_both_halves_are_held_out_and_spread(policy, samples):
    made = recording(policy, samples=samples)
    held_out = sorted(made.evaluation_episodes())
    assert len(held_out) == max(4, made.episodes // 10)
    share = np.array(held_out) / made.episodes
    assert (share < 0.5).sum() == (share >= 0.5).sum() == len(held_out) / 2
    assert np.ptp(np.diff(held_out)) <= 1


def test_medium_replay_is_played_by_networks_of_all_ages(policy):
    made = recording(policy, behaviour="medium_replay", samples=10 * STEPS)
    policies = read_policies(policy, task="walker-walk", action_repeat=50, state=24, actions=6)
    ages = [next(n for n in policies.replay if made.network_of(e, policies) is policies.networks[n]) for e in range(10)]
    assert ages == sorted(ages) and set(ages) == {f"replay_{age}" for age in range(4)}
    for behaviour in ("medium", "expert"):
        alone = recording(policy, behaviour=behaviour)
        assert all(alone.network_of(e, policies) is policies.networks[behaviour] for e in range(8))


def test_held_out_episodes_show_held_out_clips(store):
    held_out = store.evaluation[store.row_episodes]
    clips = np.array(store.array("factors/clip"))
    assert store.evaluation.sum() == 4
    assert set(clips[held_out]) <= set(range(48, 52)) and set(clips[~held_out]) <= set(range(48))
    assert np.array_equal(clips, np.repeat(clips[store.starts], store.lengths)) and len(set(clips)) > 3


def test_factors_and_masks_describe_the_pictures(store):
    pool = NumberedClips("procedural", 5, size=16)
    thirds = (slice(0, 6), slice(6, 11), slice(11, 16))
    for start in store.starts[:4]:
        rows = start + np.arange(STEPS + 1)
        clip = pool.clip(int(store.array("factors/clip")[start]))
        means = np.stack([clip[:, y, x].mean((1, 2)) for y in thirds for x in thirds], 1).reshape(-1, 27) / 255
        told, masks = store.gather("factors/background", rows), store.mask("pixels", rows)
        first = int(np.abs(means - told[0]).max(1).argmin())
        playing = (first + np.arange(STEPS + 1)) % len(clip)
        assert np.allclose(means[playing], told, atol=1e-6)
        pictures = store.gather("observations/pixels", rows).transpose(0, 2, 3, 1)
        shown = (pictures == clip[playing]).all(-1)
        assert shown[:, :3][~masks[:, :3]].all(), "the sky is at the top"
        assert (shown & masks).sum() < 0.05 * masks.sum() and masks.any((1, 2)).all()


class Interrupted:
    """``collect control`` in a process of its own, killed once its bar says that some episodes are done."""

    def __init__(self, folder: Path, policy: Path) -> None:
        self.command = ["collect", "control", "x.h5", "--policy", str(policy), "--workers", "1"]
        for name, value in SMALL.items():
            if name != "progress":
                self.command += [f"--{name}", str(value)]
        self.folder = folder

    def kill_after(self, samples: int) -> str:
        process = subprocess.Popen(
            [sys.executable, "-m", "repdib_lightning", *self.command], cwd=self.folder, stderr=subprocess.PIPE,
            text=True, env={**os.environ, "TQDM_MININTERVAL": "0", "OMP_NUM_THREADS": "1"},
        )  # fmt: skip
        assert process.stderr is not None
        shown = ""
        while f"{samples}/160" not in shown and process.poll() is None:
            shown += process.stderr.read(1)
        process.send_signal(signal.SIGKILL)
        process.wait()
        return shown


def test_a_killed_recording_goes_on_to_the_same_bytes_with_another_number_of_workers(
    path, policy, tmp_path, monkeypatch, capsys
):
    monkeypatch.chdir(tmp_path)
    cut = Interrupted(tmp_path, policy)
    shown = cut.kill_after(40)
    assert os.listdir() == [".x.h5.partial"], shown
    with h5py.File(".x.h5.partial", locking=False) as file:
        assert 2 <= np.count_nonzero(file["episodes/length"]) < EPISODES
    for other, told in (
        (["--seed", "6"], "seed is 6, was 5"),
        (["--behaviour", "medium"], "behaviour"),
        (["--policy", str(write_small(tmp_path / "other.safetensors", seed=3))], "policy"),
    ):
        assert main([*cut.command, "--progress", "false", *other]) == 2
        error = capsys.readouterr().err.splitlines()
        assert len(error) == 1 and ".x.h5.partial: an unfinished recording with other options" in error[0]
        assert told.split()[0] in error[0]
    Path("other.safetensors").unlink()
    assert main([*cut.command, "--progress", "false"]) == 0
    assert Path("x.h5").read_bytes() == path.read_bytes() and os.listdir() == ["x.h5"]
    assert recompute_fingerprint(EpisodeStore("x.h5")) == EpisodeStore("x.h5").fingerprint


def test_a_recording_cut_off_before_it_was_named_is_finished_without_workers(policy, tmp_path, monkeypatch):
    monkeypatch.setattr(os, "replace", cut_off)
    options = {**SMALL, "samples": STEPS, "distractors": "none"}
    with pytest.raises(KeyboardInterrupt):
        collect_control(tmp_path / "x.h5", policy=policy, workers=1, **options)
    monkeypatch.undo()
    began = time.perf_counter()
    collect_control(tmp_path / "x.h5", policy=policy, workers=2, **options)
    assert EpisodeStore(tmp_path / "x.h5").lengths.tolist() == [STEPS + 1] and time.perf_counter() - began < 30
    assert os.listdir(tmp_path) == ["x.h5"]


def cut_off(*_: Any) -> None:
    raise KeyboardInterrupt


@pytest.fixture
def complain(tmp_path, monkeypatch, capsys) -> Callable[..., str]:
    """Run ``collect control``, which must fail; return its one line."""
    monkeypatch.chdir(tmp_path)

    def run(*options: str) -> str:
        before = sorted(os.listdir())
        assert main(["collect", "control", "x.h5", "--progress", "false", *options]) == 2
        error = capsys.readouterr().err.splitlines()
        assert len(error) == 1 and sorted(os.listdir()) == before
        return error[0]

    return run


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["--behaviour", "expertt"], "behaviour: unknown 'expertt', did you mean 'expert'? (choices: expert, medium, "),
        (["--quality", "papr"], "quality: unknown 'papr', did you mean 'paper'? (choices: fast, paper)"),
        (["--distractors", "vdeo"], "distractors: unknown 'vdeo', did you mean 'video'? (choices: image, none, video)"),
        (["--place", "skyfloor"], "place: unknown 'skyfloor', did you mean 'sky_floor'? (choices: side, sky, "),
        (["--task", "walkr-walk"], "task walkr-walk: unknown domain 'walkr', did you mean 'walker'?"),
        (["--task", "walker-wlk"], "task walker-wlk: unknown, did you mean 'walker-walk'?"),
        (["--task", "fish-swim"], "no policies of fish-swim ship with the package, "),
        (
            ["--task", "fish-swim", "--behaviour", "random", "--distractors", "image"],
            "place=sky: nothing of the sky is",
        ),
        (["--image_size", "15", "--behaviour", "random"], "image_size=15: must be from 16 to 512"),
        (["--image_size", "513", "--behaviour", "random"], "image_size=513: must be from 16 to 512"),
        (["--samples", "0"], "samples=0: must be at least 1"),
        (["--workers", "0"], "workers=0: must be at least 1"),
        (["--seed", "-1"], "seed=-1: must be at least 0"),
        (["--action_repeat", "0"], "action_repeat=0: must be at least 1"),
        (["--policy", "nowhere.safetensors"], "--policy nowhere.safetensors: cannot be read (No such file"),
        (["--policy", "."], "--policy .: cannot be read (Is a directory)"),
        (["--policy", "x", "--behaviour", "random"], "--policy x: random actions need none"),
        (
            ["--behaviour", "random", "--distractors", "image", "--source", "nowhere"],
            "'nowhere' is neither built in nor",
        ),
        (["--actionrepeat", "2"], "unknown option --actionrepeat, did you mean '--action_repeat'?"),
    ],
)
def test_bad_options_are_one_line_with_the_nearest_choice(complain, options, said):
    assert said in complain(*options)


def test_policies_of_something_else_are_refused_before_anything_is_played(complain, policy, tmp_path):
    name = str(policy)
    assert "was trained with action_repeat 50, this recording has 2" in complain("--policy", name)
    repeat = ["--action_repeat", "50"]
    assert "plays walker-walk, the task is walker-run" in complain("--policy", name, "--task", "walker-run", *repeat)
    Path("notes.txt").write_text("mine")
    assert "--policy notes.txt: not policies of 'collect policies'" in complain("--policy", "notes.txt", *repeat)
    write_small(Path("few.safetensors"), names=("medium", "replay_one"))
    for behaviour, missing in (("medium_expert", "expert"), ("medium_replay", "replay_0")):
        told = complain("--policy", "few.safetensors", "--behaviour", behaviour, *repeat)
        assert f"--policy few.safetensors: has no network '{missing}', " in told
    Path("x.h5").write_text("mine")
    assert "x.h5: exists already" in complain("--behaviour", "random", "--samples", "1")
    assert Path("x.h5").read_text() == "mine"


def test_python_callers_are_told_the_same(tmp_path):
    with pytest.raises(UserError, match=r"behaviour=expertt: unknown, did you mean 'expert'\?"):
        collect_control(tmp_path / "x.h5", behaviour="expertt", **SMALL)  # type: ignore[arg-type]
    assert isinstance(recording().environment(), ControlEnv)
