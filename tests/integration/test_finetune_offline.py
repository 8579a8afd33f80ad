"""``finetune td3bc`` and ``finetune bc`` from the command line, on a tiny recording of the Control Suite."""

from __future__ import annotations

import csv
import json
import math
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import av
import numpy as np
import pytest
import torch
from offline_stores import VIEW, make_bundle, register_quadrants, write_offline

from repdib_lightning.__main__ import main
from repdib_lightning.data.episodes import EpisodeStore
from repdib_lightning.errors import UserError
from repdib_lightning.export import load_encoder
from repdib_lightning.records import ActionSpec
from repdib_lightning.rl.environment import open_environment
from repdib_lightning.rl.policy_file import load_policy

PIXELS = 16
TINY = ["--steps", "5", "--batch_size", "16", "--hidden", "16", "--episodes", "2", "--film", "0", "--device", "cpu",
        "--evaluate_every", "100"]  # fmt: skip
FRESH = ["--features", "8", "--channels", "2", "--strides", "[2,2]", "--frame_stack", "2", "--shift", "1"]
SIX = ActionSpec("continuous", 6)


@pytest.fixture(scope="module", autouse=True)
def renderer():
    before = os.environ.get("MUJOCO_GL")
    os.environ.setdefault("MUJOCO_GL", "egl")
    yield
    if before is None:
        del os.environ["MUJOCO_GL"]


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    path = tmp_path_factory.mktemp("recorded") / "cartpole.h5"
    options = ["--task", "cartpole-balance", "--behaviour", "random", "--samples", "75", "--action_repeat", "40",
               "--image_size", str(PIXELS), "--workers", "1", "--distractors", "image"]  # fmt: skip
    assert main(["collect", "control", str(path), *options]) == 0
    return str(path)


@pytest.fixture(scope="module")
def bundle(tmp_path_factory):
    return str(make_bundle(tmp_path_factory.mktemp("bundle") / "b", size=PIXELS, stack=2, quantised=True))


@pytest.fixture
def here(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return tmp_path


def finetune(agent, data, *options):
    return main(["finetune", agent, "--data", data, *options])


def rows(run):
    with open(Path(run, "progress.csv"), newline="") as file:
        return list(csv.DictReader(file))


def outcome(run):
    return json.loads(Path(run, "outcome.json").read_text())


def names(folder):
    return {path.name for path in Path(folder).iterdir() if not path.name.startswith("events.")}


def content(run):
    files = (path for path in Path(run).rglob("*") if path.is_file() and not path.name.startswith("events."))
    return {str(path.relative_to(run)): path.read_bytes() for path in files}


def test_on_a_frozen_encoder(data, bundle, here, capsys):
    before = content(bundle)
    options = [*TINY, "--film", "2", "--evaluate_every", "2", "--copies", "2", "--shift", "1"]
    assert finetune("td3bc", data, "--encoder", bundle, "--run", "r", *options) == 0
    said = capsys.readouterr()
    assert said.out.startswith("return ") and said.out.endswith(", after 5 updates    wrote r\n")
    assert " over 2 episodes (normalised: " in said.out and "arning" not in said.err
    assert names("r") == {"evaluation.mp4", "finetune.json", "outcome.json", "policy.safetensors", "progress.csv"}
    assert content(bundle) == before

    table = rows("r")
    assert [row["step"] for row in table] == ["2", "4", "5"]
    assert list(table[0]) == ["step", "eval/return", "eval/normalised", "train/critic", "train/clone", "train/value"]
    assert all(math.isfinite(float(value)) for row in table for value in row.values())

    found = outcome("r")
    told = {"agent", "environment", "environment_options", "versions", "configuration", "data", "measures", "maps"}
    assert set(found) == told and found["agent"] == "td3bc" and found["environment"] == "repdib/Control-v0"
    assert found["environment_options"]["evaluation"] and "task" in found["environment_options"]
    assert found["data"] == {"file": "cartpole.h5", "fingerprint": EpisodeStore(data).fingerprint}
    assert found["configuration"] == json.loads(Path("r/finetune.json").read_text())
    assert found["configuration"]["values"]["alpha"] == 2.5 and found["configuration"]["encoder"] == bundle
    measures = found["measures"]
    assert set(measures) == {"return", "normalised", "return_deviation", "mean_return", "clone_error"}
    assert 0 < measures["return"] < 1000 and measures["normalised"] == pytest.approx(measures["return"] / 10)
    assert measures["return"] == pytest.approx(float(table[-1]["eval/return"]), rel=1e-4)
    assert measures["mean_return"] == pytest.approx(np.mean([float(row["eval/return"]) for row in table]), rel=1e-4)

    with av.open("r/evaluation.mp4") as film:
        stream = film.streams.video[0]
        assert (stream.height, stream.width) == (8 * PIXELS, 8 * (2 * PIXELS + 4))
        pictures = [frame.to_ndarray(format="rgb24") for frame in film.decode(stream)]
    assert len(pictures) == 25 and np.ptp(pictures[0][:, : 8 * PIXELS]) > 50
    assert load_policy("r")(np.zeros((3, 6, PIXELS, PIXELS), np.uint8)).shape == (3, 1)


@pytest.mark.parametrize("agent", ["td3bc", "bc"])
def test_end_to_end_an_encoder_is_trained_and_saved(data, here, agent):
    assert finetune(agent, data, "--run", "r", *TINY, *FRESH) == 0
    assert names("r") == {"bundle", "finetune.json", "outcome.json", "policy.safetensors", "progress.csv"}
    assert finetune(agent, data, "--run", "longer", *TINY, *FRESH, "--steps", "6", "--env", "none") == 0
    encoder, longer = load_encoder("r/bundle"), load_encoder("longer/bundle")
    assert encoder.features == 8 and encoder.spec.frame_stack == 2
    assert encoder.spec.observations[VIEW].shape == (6, PIXELS, PIXELS)
    moved = [not torch.equal(one, other) for one, other in zip(encoder.parameters(), longer.parameters(), strict=True)]
    assert all(moved) and len(moved) == 8
    # What one run has trained is an encoder like any other to the next.
    assert finetune("td3bc", data, "--encoder", "r", "--run", "next", *TINY, "--env", "none") == 0
    assert names("next") == {"finetune.json", "outcome.json", "policy.safetensors", "progress.csv"}
    assert load_policy("next")(np.zeros((6, PIXELS, PIXELS), np.uint8)).shape == (1,)


@pytest.mark.parametrize("encoder", ["frozen", "fresh"])
def test_a_seed_decides_everything_and_evaluations_nothing(data, bundle, here, encoder):
    chosen = ["--encoder", bundle, "--copies", "2"] if encoder == "frozen" else FRESH
    for run, seed, every in (("a", "0", "3"), ("b", "0", "3"), ("often", "0", "1"), ("other", "1", "5")):
        options = [*TINY, *chosen, "--seed", seed, "--evaluate_every", every, "--film", "1"]
        assert finetune("td3bc", data, "--run", run, *options) == 0
    a, b, often, other = map(content, ("a", "b", "often", "other"))
    assert a == b and a["progress.csv"] != other["progress.csv"]
    trained = ["policy.safetensors", "evaluation.mp4", *(["bundle/model.safetensors"] if encoder == "fresh" else [])]
    for name in trained:
        assert a[name] == often[name] != other[name], name
    assert rows("a")[-1] == rows("often")[-1] and len(rows("often")) == 5


def test_without_an_environment(data, bundle, here, capsys):
    capsys.readouterr()
    assert finetune("bc", data, "--encoder", bundle, "--run", "r", "--env", "none", *TINY, "--evaluate_every", "2") == 0
    assert capsys.readouterr().out == "5 updates    wrote r\n"
    assert names("r") == {"finetune.json", "outcome.json", "policy.safetensors", "progress.csv"}
    assert [list(row) for row in rows("r")] == [["step", "train/clone"]] * 3
    assert set(outcome("r")["measures"]) == {"clone_error"} and outcome("r")["environment"] == "none"
    assert outcome("r")["measures"]["clone_error"] == pytest.approx(float(rows("r")[-1]["train/clone"]), rel=1e-4)


def test_other_distractors_than_those_of_the_data(data, bundle, here):
    for kind in ("none", "video"):
        options = ["--env_options.distractors", kind, "--film", "1"]
        assert finetune("bc", data, "--encoder", bundle, "--run", kind, *TINY, *options) == 0
        assert 0 < outcome(kind)["measures"]["return"] < 1000
    skies = []
    for kind in ("none", "video"):
        with av.open(f"{kind}/evaluation.mp4") as film:
            pictures = [frame.to_ndarray(format="rgb24")[:12, :30].astype(float) for frame in film.decode(video=0)]
        skies.append(np.abs(np.diff(np.stack(pictures), axis=0)).mean())
    assert skies[1] > 4 * skies[0]  # a video plays behind


def test_cloning_needs_neither_rewards_nor_a_known_environment(bundle, here, capsys):
    """The environment is one of the user's own."""
    write_offline(here / "mine.h5", lengths=[12, 12], evaluation=[], rewards=False)
    options = [*TINY, *FRESH, "--env", register_quadrants(), "--film", "1"]
    assert finetune("bc", "mine.h5", "--run", "r", *options) == 0
    assert -20 < outcome("r")["measures"]["return"] < 5 and outcome("r")["environment"] == register_quadrants()
    assert "has no 'rewards'" in complaint(capsys, "td3bc", "mine.h5", *options, "--run", "x")


def test_imported_vd4rl_is_evaluated_in_paper_quality(here, monkeypatch):
    """500 steps of it are long; what is opened tells enough."""
    write_offline(here / "vd4rl.h5", actions=SIX, size=PIXELS, environment="dm_control/walker_walk")
    opened = []

    def noted(name, options):
        opened.append((name, options))
        return open_environment(name, options)

    monkeypatch.setattr("repdib_lightning.rl.offline_evaluation.open_environment", noted)
    monkeypatch.setattr("repdib_lightning.rl.offline_training.EpisodesAtOnce.run", lambda *_: (np.zeros(2), []))
    assert finetune("td3bc", "vd4rl.h5", "--run", "r", *TINY, *FRESH) == 0
    options = {"task": "walker_walk", "action_repeat": 2, "image_size": PIXELS, "quality": "paper", "evaluation": True}
    assert opened == [("repdib/Control-v0", options)] * 2
    assert outcome("r")["environment"] == "repdib/Control-v0" and outcome("r")["environment_options"] == options


def complaint(capsys, agent, data, *options):
    """Run a command that must fail; return its one line. Nothing may be left behind."""
    capsys.readouterr()
    before = sorted(Path().rglob("*"))
    assert finetune(agent, data, *options) == 2
    error = capsys.readouterr().err.strip().splitlines()
    assert len(error) == 1 and error[0].startswith("error: "), error
    assert sorted(Path().rglob("*")) == before, "something was left behind"
    return error[0]


@pytest.mark.parametrize(
    ("options", "wanted"),
    [
        (
            ["--env_options.action_repeat", "2"],
            "--env_options.action_repeat 2: cartpole.h5 was recorded with 40; leave",
        ),
        (
            ["--env_options.task", "cheetah-run"],
            "--env_options.task cheetah-run: cartpole.h5 was recorded with cartpole-",
        ),
        (["--env_options.image_size", "64"], "--env_options.image_size 64: cartpole.h5 was recorded with 16; leave it"),
        (["--env_options.distractors", "vidoe"], "distractors=vidoe: unknown, did you mean 'video'?"),
        (["--env_options.distracters", "video"], "distracters: no option of repdib/Control-v0, did you mean 'distra"),
        (["--env_options.source", "nowhere"], "'nowhere' is neither built in nor a folder"),
        (
            ["--env_options.place", "side"],
            "does not fit --env repdib/Control-v0: the environment's observation 'pixels",
        ),
        (["--env", "Contrl"], "--env Contrl: no such environment, did you mean 'Control'?"),
        (["--env", "Acrobot-v1"], "its actions are Discrete(3), those of the data are continuous, 1 wide"),
        (["--env", "Pendulum-v1"], "'pixels' is float32, the encoder takes uint8"),
        (["--env", "none", "--env_options.place", "sky"], "--env_options mean nothing with --env none"),
        (["--steps", "0"], "--steps must be at least 1, is 0"),
        (["--batch_size", "0"], "--batch_size must be at least 1, is 0"),
        (["--batch_size", "51"], "--batch_size 51: cartpole.h5 has 50 transitions to train on"),
        (["--hidden", "0"], "--hidden must be at least 1, is 0"),
        (["--n_steps", "0"], "--n_steps must be at least 1, is 0"),
        (["--evaluate_every", "0"], "--evaluate_every must be at least 1, is 0"),
        (["--episodes", "0"], "--episodes must be at least 1, is 0"),
        (["--copies", "0"], "--copies must be at least 1, is 0"),
        (["--copies", "2"], "--copies are of frames that a given encoder encodes once; leave it out without --encoder"),
        (["--film", "-1"], "--film must be from 0 to 4294967295, is -1"),
        (["--seed", "-1"], "--seed must be from 0 to 4294967295, is -1"),
        (["--seed", "4294967296"], "--seed must be from 0 to 4294967295, is 4294967296"),
        (["--shift", "-1"], "--shift must be from 0 to"),
        (["--learning_rate", "0"], "--learning_rate must be above 0 and finite, is 0.0"),
        (["--learning_rate", ".nan"], "--learning_rate must be above 0 and finite, is nan"),
        (["--learning_rate", ".inf"], "--learning_rate must be above 0 and finite, is inf"),
        (["--gamma", "1.01"], "--gamma must be in [0, 1], is 1.01"),
        (["--alpha", "-1"], "--alpha must be finite and not negative, is -1.0"),
        (["--alpha", ".inf"], "--alpha must be finite and not negative, is inf"),
        (["--noise", "-0.1"], "--noise must be finite and not negative, is -0.1"),
        (["--noise_clip", ".nan"], "--noise_clip must be finite and not negative, is nan"),
        (["--tau", "0"], "--tau must be above 0 and at most 1, is 0.0"),
        (["--tau", "1.5"], "--tau must be above 0 and at most 1, is 1.5"),
        (["--steps", "many"], "steps: expected int, got 'many'"),
        (["--stepss", "5"], "unknown option --stepss, did you mean '--steps'?"),
        (["--device", "gpu"], "--device gpu: there is no such device, did you mean 'cpu'? (choices: auto, cpu, cuda)"),
        (["--device", "cuda:99"], "--device 'cuda:99' cannot be used here, "),
        (["--encoder", "nowhere"], "--encoder nowhere: no such bundle; export one: python -m repdib_lightning export"),
        (["--encoder", "taken"], "--encoder taken: holds no bundle; export one"),
        (["--features", "8", "--encoder", "x"], "--features is of an encoder that the agent trains; leave it out besi"),
        (["--strides", "[2]", "--encoder", "x"], "--strides is of an encoder that the agent trains; leave it out"),
        (["--frame_stack", "1", "--encoder", "x"], "--frame_stack is of an encoder that the agent trains; leave"),
        (["--features", "0"], "--features must be at least 1, is 0"),
        (["--frame_stack", "0"], "--frame_stack must be at least 1, is 0"),
        (["--channels", "-2"], "--channels must be at least 1, is -2"),
        (["--strides", "[]"], "--strides must be at least 1, is []"),
        (["--strides", "[2,0]"], "--strides must be at least 1, is [2, 0]"),
        (["--strides", "[9,9,9]"], "16x16 pixels is too small for strides"),
        (["--run", "taken"], "--run taken: exists already; choose another folder or pass --overwrite"),
        (["--run", "taken", "--overwrite"], "--run taken: is no run of finetune, so --overwrite does not replace it"),
        (["--run", "taken/file/r"], "--run taken/file/r: cannot be made (Not a directory)"),
    ],
)
def test_bad_input_is_one_line_and_leaves_nothing(data, here, capsys, options, wanted):
    Path("taken").mkdir()
    Path("taken/file").write_text("mine")
    Path("cartpole.h5").symlink_to(data)
    rest = {"--run": "r", "--batch_size": "16", "--episodes": "1"}
    run = [word for name, value in rest.items() if name not in options for word in (name, value)]
    assert wanted in complaint(capsys, "td3bc", "cartpole.h5", *options, *run)


def test_data_that_do_not_fit_are_one_line_and_leave_nothing(data, bundle, here, capsys):
    write_offline(here / "discrete.h5", actions=ActionSpec("discrete", 3))
    write_offline(here / "other.h5", size=PIXELS, actions=SIX)
    write_offline(here / "small.h5", size=12, actions=SIX, environment="dm_control/walker_walk")
    run = ["--run", "r", "--batch_size", "4"]
    for agent in ("td3bc", "bc"):
        said = complaint(capsys, agent, "discrete.h5", *run)
        assert said.endswith("discrete.h5: offline agents need continuous actions, these are discrete")
    assert "nowhere.h5: no such data file" in complaint(capsys, "bc", "nowhere.h5", *run)
    said = complaint(capsys, "bc", "other.h5", *run)
    assert "other.h5: does not tell in which environment it was recorded; name one with --env, or train" in said
    said = complaint(capsys, "bc", "small.h5", "--encoder", bundle, *run)
    assert said.endswith(
        f"small.h5: observation 'pixels' is 6x12x12 uint8 (stack of 2), {bundle} was trained on 6x16x16 uint8"
    )
    said = complaint(capsys, "bc", data, "--encoder", str(make_bundle(here / "eight")), *run)
    assert said.endswith(f"observation 'pixels' is 3x16x16 uint8, {here / 'eight'} was trained on 3x8x8 uint8")
    assert "image_size=12: " in complaint(capsys, "bc", "small.h5", *run, *FRESH)


def test_a_run_is_replaced_only_when_asked_and_never_with_what_it_is_made_of(data, bundle, here, capsys):
    shared = ["--env", "none", *TINY]
    assert finetune("td3bc", data, "--run", "r", *shared, *FRESH) == 0
    before = content("r")
    assert "exists already" in complaint(capsys, "bc", data, "--run", "r", *shared)
    complaint(capsys, "bc", data, "--run", "r", "--overwrite", *shared, "--batch_size", "1000")
    said = complaint(capsys, "td3bc", data, "--run", "r", "--overwrite", "--encoder", "r/bundle", *shared)
    assert said == "error: --run r: holds --encoder r/bundle; choose another folder"
    write_offline(here / "r" / "data.h5", actions=SIX)
    said = complaint(capsys, "td3bc", "r/data.h5", "--run", "r", "--overwrite", *shared)
    assert said == "error: --run r: holds --data r/data.h5; choose another folder"
    Path("r/data.h5").unlink()
    assert content("r") == before
    assert finetune("bc", data, "--run", "r", "--overwrite", "--encoder", bundle, *shared) == 0
    assert names("r") == {"finetune.json", "outcome.json", "policy.safetensors", "progress.csv"}


def test_a_training_that_diverges_is_one_line(data, bundle, here, capsys):
    options = ["--encoder", bundle, "--env", "none", *TINY, "--learning_rate", "1e30", "--steps", "9"]
    capsys.readouterr()
    assert finetune("td3bc", data, "--run", "r", *options) == 2
    error = capsys.readouterr().err.strip().splitlines()
    assert len(error) == 1 and error[0].startswith("error: train/") and "smaller --learning_rate" in error[0]
    assert not Path("r/outcome.json").exists()


def test_divergence_is_one_line_where_the_agent_is_evaluated(data, bundle, here, capsys):
    options = ["--encoder", bundle, "--run", "r", *TINY, "--learning_rate", "1e30", "--steps", "9"]
    assert finetune("td3bc", data, *options) == 2
    assert "smaller --learning_rate" in capsys.readouterr().err and not Path("r/outcome.json").exists()


def test_what_a_suite_asks_before_hours_of_pretraining(data, here, tmp_path):
    from repdib_lightning.verbs import check_finetune

    check_finetune(["td3bc", "--data", data, *TINY])
    check_finetune(["td3bc", "--data", "not_yet.h5", *TINY])
    poor = write_offline(tmp_path / "poor.h5", rewards=False)
    for words, said in (
        (["--data", data, "--env_options.task", "cheetah-run"], "was recorded with cartpole-balance"),
        (["--data", data, "--batch_size", "9999"], "transitions to train on"),
        (["--data", str(poor)], "has no 'rewards'"),
        (["--data", data, "--env_options.quality", "papr"], "unknown, did you mean 'paper'"),
    ):
        with pytest.raises(UserError, match=said):
            check_finetune(["td3bc", *TINY, *words])


@pytest.mark.parametrize(("number", "code"), [(signal.SIGTERM, 143), (signal.SIGINT, 130)])
def test_a_stopped_training_says_so_by_its_exit_code(data, bundle, here, number, code):
    options = ["--data", data, "--encoder", bundle, "--run", "r", "--env", "none", "--steps", "1000000",
               "--batch_size", "16", "--hidden", "16", "--device", "cpu", "--evaluate_every", "20"]  # fmt: skip
    command = [sys.executable, "-m", "repdib_lightning", "finetune", "td3bc", *options]
    heeded = lambda: signal.signal(signal.SIGINT, signal.default_int_handler)  # noqa: E731 (a shell may ignore it)
    process = subprocess.Popen(command, stderr=subprocess.PIPE, text=True, preexec_fn=heeded)
    try:
        for _ in range(1200):
            if Path("r/progress.csv").is_file():
                break
            time.sleep(0.05)
        process.send_signal(number)
        assert process.wait(60) == code
    finally:
        process.kill()
    assert not Path("r/outcome.json").exists()
