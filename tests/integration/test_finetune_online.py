"""``finetune ddpg`` and ``finetune sac`` from the command line, on a snapshot that nobody has trained."""

from __future__ import annotations

import csv
import json
import math
import os
import shutil
import sys
from pathlib import Path

import av
import numpy as np
import pytest
from online_snapshots import EPISODE, FRESH, OTHER_TASK, PIXELS, SCENE, SMALL, TASK, WIDTH, make_run, play_toys, words

from repdib_lightning.__main__ import main
from repdib_lightning.errors import UserError
from repdib_lightning.experiments.measures import collect_measures
from repdib_lightning.export import load_encoder
from repdib_lightning.verbs import check_finetune

TINY = words(SMALL)
MADE = [*words(FRESH), *words({f"env_options.{name}": value for name, value in SCENE.items()})]
MEASURES = {"return", "return_deviation", "mean_return", "first_return", "best_return", "frames"}


@pytest.fixture(scope="module", autouse=True)
def renderer():
    before = os.environ.get("MUJOCO_GL")
    os.environ.setdefault("MUJOCO_GL", "egl")
    yield
    if before is None:
        del os.environ["MUJOCO_GL"]


@pytest.fixture(scope="module")
def explored(tmp_path_factory):
    return make_run(tmp_path_factory.mktemp("explored") / "x")


@pytest.fixture
def here(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture
def toys(monkeypatch):
    """In place of the simulator, which takes its time."""
    play_toys(monkeypatch)


def finetune(agent, *options):
    return main(["finetune", agent, *map(str, options)])


def rows(run):
    with open(Path(run, "progress.csv"), newline="") as file:
        return list(csv.DictReader(file))


def outcome(run):
    return json.loads(Path(run, "outcome.json").read_text())


def names(folder):
    return {path.name for path in Path(folder).iterdir() if not path.name.startswith("events.")}


def content(folder):
    files = (path for path in Path(folder).rglob("*") if path.is_file() and not path.name.startswith("events."))
    return {str(path.relative_to(folder)): path.read_bytes() for path in files}


def test_ddpg_on_a_snapshot(explored, here, capsys):
    before = content(explored)
    options = ["--encoder", explored, "--snapshot", 1000, "--task", OTHER_TASK, "--run", "r", *TINY, "--film", "1"]
    assert finetune("ddpg", *options) == 0
    said = capsys.readouterr()
    assert said.out.startswith(f"{OTHER_TASK}: return ") and said.out.endswith(" before    wrote r\n")
    assert " over 2 episodes after 3000 frames, " in said.out and "arning" not in said.err
    assert names("r") == {
        "evaluation.mp4", "finetune.json", "outcome.json", "policy.safetensors", "progress.csv", "values.npz",
    }  # fmt: skip
    assert content(explored) == before

    table = rows("r")
    assert [row["step"] for row in table] == ["0", "1050", "2050", "3000"]
    assert list(table[0]) == ["step", "eval/return", "train/return", "train/critic", "train/value", "train/actor"]
    assert table[0]["train/critic"] == "" and all(math.isfinite(float(cell)) for cell in table[-1].values())

    found = outcome("r")
    assert found["agent"] == "ddpg" and found["environment"] == "repdib/Control-v0"
    assert found["environment_options"] == {"task": OTHER_TASK, **SCENE, "evaluation": True}
    used = found["configuration"]
    assert used == json.loads(Path("r/finetune.json").read_text())
    assert (used["snapshot"], used["agent"], used["frozen"], used["hidden"]) == (1000, "actor", True, 16)
    assert set(found["measures"]) == MEASURES and all(map(math.isfinite, found["measures"].values()))
    returns = [float(row["eval/return"]) for row in table]
    assert found["measures"]["mean_return"] == pytest.approx(np.mean(returns), rel=1e-4)
    assert found["measures"]["first_return"] == pytest.approx(returns[0], rel=1e-4)
    assert found["measures"]["return"] == pytest.approx(returns[-1], rel=1e-4)
    assert found["measures"]["best_return"] == pytest.approx(max(returns), rel=1e-4)

    with av.open("r/evaluation.mp4") as film:
        pictures = [frame.to_ndarray(format="rgb24") for frame in film.decode(video=0)]
    assert len(pictures) == EPISODE and pictures[0].shape[0] == 8 * PIXELS
    kept = np.load("r/values.npz")
    assert kept["latents"].shape == (2 * EPISODE, WIDTH) and kept["values"].shape == (2 * EPISODE,)


def test_a_suite_reads_what_was_reached(explored, here):
    for agent in ("ddpg", "sac"):
        assert finetune(agent, "--encoder", explored, "--run", agent, "--hidden", 16, *TINY, "--episodes", 1) == 0
        facts = collect_measures(Path("."), None, {"here": Path(agent, "outcome.json")})
        assert set(facts.metrics) == {f"{agent}/here/{name}" for name in MEASURES}
        assert facts.configuration["finetune"]["here"]["task"] == TASK and facts.versions["mujoco"]


@pytest.mark.parametrize("agent", ["ddpg", "sac"])
def test_an_encoder_is_trained_and_saved(explored, here, toys, agent):
    options = ["--encoder", explored, "--frozen", "false", "--shift", 1, "--hidden", 16, "--learning_rate", 1e-2, *TINY]
    assert finetune(agent, *options, "--run", "r") == 0
    policy = "policy.zip" if agent == "sac" else "policy.safetensors"
    assert names("r") == {"bundle", "finetune.json", "outcome.json", policy, "progress.csv", "values.npz"}
    assert {"train/kl", "train/commitment", "train/perplexity"} <= set(rows("r")[-1])
    picture = np.random.default_rng(0).integers(0, 256, (5, 6, PIXELS, PIXELS), dtype=np.uint8)
    given = load_encoder(explored / "snapshots" / "frames-000002000")
    after = load_encoder("r/bundle")
    assert not np.allclose(given.encode(picture), after.encode(picture)) and after.groups == 4
    # What one run has trained is an encoder like any other to the next.
    assert finetune("ddpg", "--encoder", "r", "--task", TASK, "--env_options.action_repeat", 50, "--run", "next",
                    "--hidden", 16, *TINY) == 0  # fmt: skip
    assert outcome("next")["configuration"]["agent"] == "fresh"


@pytest.mark.parametrize(
    ("agent", "given"),
    [("ddpg", "frozen"), ("ddpg", "trained"), ("sac", "frozen"), ("sac", "trained"), ("ddpg", "fresh")],
)
def test_a_seed_decides_everything_and_evaluations_nothing(explored, here, request, agent, given):
    if (agent, given) != ("ddpg", "frozen"):
        request.getfixturevalue("toys")
    chosen = ["--task", TASK, *MADE] if given == "fresh" else ["--encoder", explored]
    if given == "trained":
        chosen += ["--frozen", "false", "--shift", 1]
    extra = [] if agent == "ddpg" and given != "fresh" else ["--hidden", 16]
    for run, seed, every in (("a", 0, 1000), ("b", 0, 1000), ("rarely", 0, 3000), ("other", 1, 3000)):
        more = ["--seed", seed, "--evaluate_every", every, "--run", run, "--episodes", 1]
        assert finetune(agent, *chosen, *extra, *TINY, *more) == 0
    a, b, rarely, other = map(content, ("a", "b", "rarely", "other"))
    assert rows("a") == rows("b") and {**a, "policy.zip": 0} == {**b, "policy.zip": 0}  # a zip file tells its time
    last = {name: value for name, value in rows("a")[-1].items() if name != "train/return"}  # since the last row
    assert last == {name: value for name, value in rows("rarely")[-1].items() if name != "train/return"}
    assert a["values.npz"] == rarely["values.npz"] != other["values.npz"] and rows("a") != rows("other")


def complaint(capsys, agent, *options):
    """Run a command that must fail; return its one line. Nothing may be left behind."""
    capsys.readouterr()
    before = sorted(Path().rglob("*"))
    assert finetune(agent, *options) == 2
    error = capsys.readouterr().err.strip().splitlines()
    assert len(error) == 1 and error[0].startswith("error: "), error
    assert sorted(Path().rglob("*")) == before, "something was left behind"
    return error[0]


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["--task", "walker-rn"], "--task walker-rn: unknown, did you mean 'walker-run'?"),
        (["--task", "walkrun"], "jaco-reach_bottom_left, jaco-reach_bottom_right"),
        (
            ["--task", "walker-run"],
            "--task walker-run: has 6 actions, the agent of x/snapshots/frames-000002000 explored",
        ),
        (["--snapshot", "1500"], "--snapshot 1500: not in x, which has 1000, 2000"),
        (["--encoder", "nowhere"], "--encoder nowhere: no such bundle; export one"),
        (["--features", "8"], "--features: is of a fresh encoder, --encoder x has its own; leave it out"),
        (
            ["--bottleneck_losses", "0.5"],
            "--bottleneck_losses is of an encoder that the agent trains; add --frozen fals",
        ),
        (["--agent", "pretrained"], "--agent pretrained: unknown, choices: actor, both, fresh"),
        (
            ["--env_options.image_size", "20"],
            "--encoder x: does not fit cartpole-balance: the environment's observation",
        ),
        (
            ["--env_options.distracters", "video"],
            "--env_options.distracters: no such option, did you mean 'distractors'",
        ),
        (["--env_options.task", "walker-run"], "--env_options.task: name it with --task"),
        (["--frames", "0"], "--frames must be at least 1, is 0"),
        (["--frames", "many"], "frames: expected int, got 'many'"),
        (["--frozen", "maybe"], "frozen: expected bool, got 'maybe'"),
        (["--batch_size", "1000"], "--batch_size 1000: --seed_frames 1050 are 20 transitions of whole episodes"),
        (["--gama", "1"], "unknown option --gama, did you mean '--gamma'?"),
        (["--device", "cuda:99"], "--device 'cuda:99' cannot be used here"),
        (["--run", "taken"], "--run taken: exists already; choose another folder or pass --overwrite"),
        (["--run", "taken", "--overwrite"], "--run taken: is no run of finetune, so --overwrite does not replace it"),
    ],
)
def test_bad_input_is_one_line_and_leaves_nothing(explored, here, capsys, options, said):
    Path("taken").mkdir()
    Path("taken/file").write_text("mine")
    Path("x").symlink_to(explored)
    rest = {"--encoder": "x", "--run": "r", **dict(zip(TINY[::2], TINY[1::2], strict=True))}
    assert said in complaint(
        capsys, "ddpg", *options, *(w for n, v in rest.items() if n not in options for w in (n, v))
    )


def test_a_run_is_replaced_only_when_asked_and_never_with_its_encoder(explored, here, toys, capsys):
    assert finetune("ddpg", "--task", TASK, *MADE, "--hidden", 8, *TINY, "--run", "r") == 0
    before = content("r")
    shared = ["--task", TASK, "--env_options.action_repeat", 50, "--hidden", 8, *TINY, "--run", "r"]
    assert "exists already" in complaint(capsys, "ddpg", "--encoder", explored, *shared)
    said = complaint(capsys, "sac", "--encoder", "r/bundle", *shared, "--overwrite")
    assert said == "error: --run r: holds --encoder r/bundle; choose another folder"
    complaint(capsys, "ddpg", "--encoder", explored, *shared, "--overwrite", "--batch_size", 1000, "--agent", "fresh")
    assert content("r") == before
    assert finetune("sac", "--encoder", explored, *shared, "--overwrite") == 0
    assert "bundle" not in names("r") and outcome("r")["agent"] == "sac"


def test_what_a_suite_asks_before_hours_of_pretraining(here, monkeypatch):
    for agent in ("ddpg", "sac"):
        check_finetune([agent, "--encoder", "not_yet", "--snapshot", "1000", "--task", TASK, *TINY])
        check_finetune([agent, "--encoder", "not_yet", *TINY])
        for options, said in (
            (["--task", "cartpole-swngup"], "did you mean 'cartpole-swingup'"),
            (["--task", TASK, "--env_options.quality", "papr"], "unknown, did you mean 'paper'"),
            (["--gamma", "2"], "--gamma must be in"),
            (["--strides", "[2]"], "--strides: is of a fresh encoder"),
        ):
            with pytest.raises(UserError, match=said):
                check_finetune([agent, "--encoder", "not_yet", *TINY, *options])
    monkeypatch.setitem(sys.modules, "stable_baselines3", None)
    check_finetune(["ddpg", "--task", TASK, *TINY])
    with pytest.raises(UserError, match="finetune sac needs Stable-Baselines3: pip install"):
        check_finetune(["sac", "--task", TASK, *TINY])


def test_a_snapshot_without_its_agent_is_an_encoder(explored, here, capsys):
    shutil.copytree(explored / "snapshots" / "frames-000001000", "b", ignore=shutil.ignore_patterns("agent.*"))
    assert "--agent both: b holds an encoder alone" in complaint(
        capsys, "ddpg", "--encoder", "b", "--agent", "both", "--task", TASK, *TINY
    )
    assert "--task: name one, such as walker-run" in complaint(capsys, "ddpg", "--encoder", "b", *TINY)
