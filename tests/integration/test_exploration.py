"""Explorations through the command line: every domain to its end, what breaks, and bad input in one line."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import numpy as np
import pytest
import torch

sys.path.insert(0, str(Path(__file__).parent))
from small_exploration import REPEAT, SIDE, TINY, complaint, fit, rows

from repdib_lightning.__main__ import main
from repdib_lightning.callbacks import last_good, read_status
from repdib_lightning.data.episodes import EpisodeStore
from repdib_lightning.data.fingerprint import recompute_fingerprint
from repdib_lightning.export import load_encoder
from repdib_lightning.rl.exploration.snapshots import find_snapshot, read_agent, snapshots_of


@pytest.fixture
def here(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return tmp_path


def films(run):
    """Frames of each film in TensorBoard's file."""
    import io

    from PIL import Image
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    board = EventAccumulator(str(run), size_guidance={"images": 0})
    board.Reload()
    shown = [event.encoded_image_string for event in board.Images("explore/episode")]
    return [Image.open(io.BytesIO(content)) for content in shown]


@pytest.mark.parametrize(
    ("task", "steps", "actions"),
    [("walker-stand", 20, 6), ("quadruped-walk", 20, 12), ("jaco-reach_top_left", 5, 9)],
)
def test_every_domain_from_exploring_to_a_snapshot(here, capsys, task, steps, actions):
    more = [*TINY, "--data.task", task, "--data.environments", "1", "--data.hold_out_every", "2"]
    limits = ["--data.frames", "2000", "--data.snapshots", "[1500,2000]", "--trainer.log_every_n_steps", "1"]
    seeds = ["--data.batch_size", "4", "--model.bottleneck.init_args.start_step", "1"]
    assert main(["fit", *more, *limits, *seeds, "--run", "runs/x"]) == 0
    store = EpisodeStore("runs/x/replay.h5")
    assert store.lengths.tolist() == [steps + 1] * (2000 // REPEAT // steps)
    assert (
        store.array("observations/pixels").shape[1:] == (3, SIDE, SIDE) and store.array("actions").shape[1] == actions
    )
    assert store.evaluation.tolist() == [number % 2 == 1 for number in range(len(store.lengths))]
    assert json.loads(store.attributes["configuration"])["task"] == task
    assert recompute_fingerprint(store) == store.fingerprint
    assert {spec.kind for spec in store.factors.values()} == {"endogenous"}
    assert main(["inspect", "runs/x/replay.h5"]) == 0 and "pixels" in capsys.readouterr().out

    told = {name: [float(row[name]) for row in rows("runs/x") if row[name]] for name in rows("runs/x")[0]}
    assert len(told["explore/intrinsic_reward"]) == (2000 // REPEAT - steps - 1) // 2
    assert np.all(np.diff(told["explore/coverage"]) >= 0) and told["explore/coverage"][0] >= 1
    returns = store.array("rewards").reshape(-1, steps + 1)[:, :steps].sum(1)
    np.testing.assert_allclose(told["explore/task_return"], returns[: len(told["explore/task_return"])], 1e-5, 1e-30)
    film = films(Path("runs/x"))[0]
    assert film.n_frames == steps + 1 and film.size == (SIDE, SIDE)

    assert main(["export", "runs/x"]) == 0
    exported, last = load_encoder("runs/x/bundle"), find_snapshot(Path("runs/x"))
    assert list(snapshots_of(Path("runs/x"))) == [1500, 2000] and last == snapshots_of(Path("runs/x"))[2000]
    seen = {"pixels": torch.from_numpy(np.concatenate([store.array("observations/pixels")[:3]] * 3, axis=1))}
    codes = [load_encoder(folder).codes(seen) for folder in snapshots_of(Path("runs/x")).values()]
    assert torch.equal(codes[-1], exported.codes(seen)) and codes[0].shape == (3, 4)
    facts = read_agent(last).facts
    assert (facts["task"], facts["frames"], facts["actions"], facts["hidden"]) == (task, 2000, actions, 16)
    assert (facts["image_size"], facts["action_repeat"], facts["features"]) == (SIDE, REPEAT, 16)


def test_what_is_logged_now_and_then_is_what_is_logged_at_every_step(here):
    often, seldom = (
        {row["step"]: row for row in rows(name) if row["train/loss"]}
        for name, every in (("a", "1"), ("b", "4"))
        if main(fit(name, 3000, "[2500]", "--data.environments", "1", "--trainer.log_every_n_steps", every)) == 0
    )
    assert list(often) == [str(step) for step in range(19)] and list(seldom) == ["3", "7", "11", "15"]
    assert all(row == often[step] for step, row in seldom.items())


def test_a_critic_that_breaks_leaves_one_line_a_snapshot_and_a_run_to_look_at(here, capsys):
    breaking = ["--model.value_limit", "1e-9", "--trainer.log_every_n_steps", "1"]
    started = ["--model.bottleneck.init_args.start", "random", "--model.bottleneck.init_args.start_step", "0"]
    assert main(fit("runs/b", 4000, "[3000]", *breaking, *started)) == 2
    (error,) = capsys.readouterr().err.strip().splitlines()
    assert error.startswith("error: step 1: the critics' mean value is ") and "model.value_limit 1e-09" in error
    assert read_status(Path("runs/b")).state == "failed"
    found = find_snapshot(Path("runs/b"))
    assert list(snapshots_of(Path("runs/b"))) == [2100]
    pictures = torch.zeros(2, 9, SIDE, SIDE, dtype=torch.uint8)
    assert load_encoder(found).encode({"pixels": pictures}).isfinite().all()
    agent = read_agent(found)
    begun = torch.load(last_good(Path("runs/b")), weights_only=True)["state_dict"]
    assert all(
        torch.equal(begun[f"agent.{name}"], value) for name, value in agent.part("").items() if "stat" not in name
    )
    assert main(["inspect", "runs/b/.replay.h5.partial"]) == 0
    assert "2 of 4 episodes" in capsys.readouterr().out
    assert main(["fit", "--resume", "runs/b"]) == 2 and "step 1: the critics' mean" in capsys.readouterr().err


WALKER = "(choices: walker-flip, walker-run, walker-stand, walker-walk)"
URLB = "URLB's: " + ", ".join(
    f"{domain}-{task}"
    for domain, tasks in (
        ("walker", ("stand", "walk", "run", "flip")),
        ("quadruped", ("stand", "walk", "run", "jump")),
        ("jaco", ("reach_top_left", "reach_top_right", "reach_bottom_left", "reach_bottom_right")),
    )
    for task in tasks
)
LATER = ["--data.seed_frames", "4100", "--data.frames", "6000", "--data.snapshots", "[]"]
HALF, NONE = ["--data.hold_out_every", "2"], ["--config", "bottleneck/none"]


@pytest.mark.parametrize(
    ("options", "wanted"),
    [
        (["--data.task", "walker-stnad"], f"task walker-stnad: unknown, did you mean 'walker-stand'? {WALKER}; {URLB}"),
        (["--data.task", "wlaker-run"], "unknown domain 'wlaker', did you mean 'walker'?"),
        (["--data.snapshots", "[4001]"], "4001 is not between the first update (2100) and the end (4000)"),
        (["--data.snapshots", "[2100]"], "data.snapshots: 2100 is not between"),
        (["--data.snapshots", "[2300]"], "after 2300 frames there were 2 updates, the quantiser starts after 3"),
        (["--data.snapshots", "some"], "data.snapshots"),
        (["--data.batch_size", "41"], "data.batch_size is 41: at the first update there are 40 transitions"),
        ([*HALF, "--data.batch_size", "21"], "data.batch_size is 21: at the first update there are 20 transitions"),
        ([*LATER, "--data.batch_size", "81"], "data.batch_size is 81: at the first update there are 80 transitions"),
        (["--data.hold_out_every", "1"], "data.hold_out_every is 1: every episode would be held out"),
        (["--data.hold_out_every", "-1"], "data.hold_out_every must not be negative"),
        (["--data.frames", "2000"], "data.frames is 2000: the first update comes after 2100 frames; choose more"),
        (["--data.frames", "0"], "data.frames must be at least 1"),
        (["--data.gamma", "1.01"], "data.gamma must be from 0 to 1"),
        (["--data.seed", str(2**63)], "data.seed must be below 2^63"),
        (["--data.environments", "0"], "data.environments must be at least 1"),
        (["--data.action_repeat", "0"], "data.action_repeat must be at least 1"),
        (["--data.image_size", "8"], "image_size"),
        (["--data.distractors", "videos"], "data.distractors: unknown 'videos', did you mean 'video'?"),
        (["--data.distractors", "image", "--data.source", "nowhere"], "nowhere"),
        (["--data", "ExploratonDataModule"], "'ExploratonDataModule', did you mean 'ExplorationDataModule'?"),
        (["--data.frmaes", "3"], "unknown key data.frmaes, did you mean 'frames'?"),
        (["--model.hiden", "3"], "unknown option --model.hiden, did you mean '--model.hidden'?"),
        ([*NONE, "--model.reward_on", "codes"], "model.reward_on is codes: this bottleneck has none; choose latent or"),
        (["--model.reward_on", "latents"], "model.reward_on: unknown 'latents', did you mean 'latent'?"),
        (["--model.duplicates", "cuont"], "did you mean 'count'?"),
        (["--model.neighbours", "65"], "neighbours must be in 1..64"),
        (["--model.tau", "2"], "model.tau must be at most 1, is 2.0"),
        (["--model.loss_weights", "{prototype: 1.0}"], "no loss is called 'prototype' in this run, did you mean"),
        (["--trainer.devices", "2"], "trainer.devices: an exploration runs in one process; set trainer.devices to 1"),
        (["--trainer.gradient_clip_val", "1.0"], "gradient clipping is not supported"),
        (["--trainer.accumulate_grad_batches", "2"], "gradient accumulation is not supported"),
    ],
)  # fmt: skip
def test_bad_input_is_one_line(here, capsys, options, wanted):
    logged = ["--trainer.log_every_n_steps", "1", "--data.environments", "2"]
    assert wanted in complaint(capsys, *fit("runs/x", 4000, "[3000]", *logged, *options))
