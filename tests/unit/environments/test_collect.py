"""Recording the robot arm: the same bytes whatever the number of workers, true factors, nothing half-written."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from repdib_lightning.data.episodes import EpisodeStore
from repdib_lightning.environments.collect_robot_arm import RobotArmRecording, collect_robot_arm, record_episode
from repdib_lightning.environments.robot_arm import Television, move
from repdib_lightning.environments.robot_arm_scene import Moment, RobotArmScene
from repdib_lightning.errors import UserError

SMALL = {"samples": 110, "episode_length": 20, "image_size": 32, "seed": 7, "progress": False}


@pytest.fixture(scope="module")
def path(tmp_path_factory) -> Path:
    return collect_robot_arm(tmp_path_factory.mktemp("arm") / "arm.h5", workers=2, **SMALL)


@pytest.fixture(scope="module")
def store(path) -> EpisodeStore:
    return EpisodeStore(path)


def test_one_worker_writes_the_same_bytes_and_another_seed_does_not(path, store, tmp_path):
    alone = collect_robot_arm(tmp_path / "alone.h5", workers=1, **SMALL)
    assert alone.read_bytes() == path.read_bytes()
    other = collect_robot_arm(tmp_path / "other.h5", workers=1, **{**SMALL, "samples": 20, "seed": 8})
    assert not np.array_equal(
        EpisodeStore(other).gather("actions", np.arange(20)), store.gather("actions", np.arange(20))
    )


def test_layout(store):
    assert store.lengths.tolist() == [21, 21, 21, 21, 21, 11]
    assert {name: spec.shape for name, spec in store.observations.items()} == dict.fromkeys(
        ["front", "top"], (3, 32, 32)
    )
    assert (store.actions_spec.kind, store.actions_spec.size) == ("discrete", 5)
    assert store.evaluation.sum() == 3 and store.contiguous
    configuration = json.loads(store.attributes["configuration"])
    assert (configuration["samples"], configuration["seed"], configuration["distractors"]) == (110, 7, "procedural")
    assert store.attributes["environment"] == "robot_arm"


def test_cells_follow_from_actions(store):
    cells, actions = store.array("factors/cell"), store.array("actions")
    for start, length in zip(store.starts, store.lengths, strict=True):
        rows = range(start, start + length)
        assert cells[start] == 4 and actions[rows[-1]] == -1
        assert [move(int(cells[t]), int(actions[t])) for t in rows[:-1]] == cells[start + 1 : start + length].tolist()


def test_factors_describe_the_pictures(store):
    """Drawing the scene again from the stored factors alone (joint noise is not stored) gives the stored pictures."""
    scene, television = RobotArmScene(32), Television("procedural", 7)
    for row in (0, 33, 70, 100):
        factor = {name: store.gather(f"factors/{name}", np.array([row]))[0] for name in store.factors}
        frame = round(float(factor["video_frame"]) * 48)
        moment = Moment(
            int(factor["cell"]),
            np.zeros(6),
            television.clip(int(factor["video"]))[frame],
            factor["lamp_colours"].reshape(3, 3),
            bool(factor["flash"]),
            float(factor["ambient"]),
            float(factor["time_step"]),
        )
        pictures, masks = scene.pictures_and_masks(moment)
        for name in ("front", "top"):
            stored, stored_mask = (
                store.gather(f"observations/{name}", np.array([row]))[0],
                store.mask(name, np.array([row]))[0],
            )
            background = ~(masks[name] | stored_mask)
            difference = np.abs(pictures[name].astype(int) - stored)[:, background]
            assert (difference <= 1).all(), f"row {row}, {name}"
            assert (masks[name] & stored_mask).sum() > 0.4 * (masks[name] | stored_mask).sum()
    scene.close()


def test_time_runs_over_the_whole_recording(store):
    assert np.allclose(store.array("factors/time_step"), np.arange(store.rows) / store.rows)


def test_evaluation_episodes_play_other_videos(store):
    held_out = store.evaluation[store.row_episodes]
    videos = store.array("factors/video")
    assert set(videos[held_out]) <= set(range(12, 16)) and set(videos[~held_out]) <= set(range(12))


@pytest.mark.parametrize(
    ("samples", "expected"),
    [(14_000, [1, 5, 8, 12, 15, 19, 22, 26]), (4_000, [1, 3, 5, 7]), (1_000, [1]), (500, [])],
)
def test_evaluation_episodes_are_spread_over_the_recording(samples, expected):
    assert sorted(RobotArmRecording(samples, 500, 64, 0, "procedural").evaluation_episodes()) == expected


def test_an_episode_depends_on_seed_and_number_alone(store):
    scene, television = RobotArmScene(32), Television("procedural", 7)
    episode = record_episode(RobotArmRecording(110, 20, 32, 7, "procedural"), 3, scene, television)
    rows = np.arange(store.starts[3], store.starts[3] + 21)
    assert np.array_equal(episode["observations"]["top"], store.gather("observations/top", rows))
    assert np.array_equal(episode["masks"]["front"], store.mask("front", rows))
    scene.close()


@pytest.mark.parametrize(
    "option",
    [{"samples": 0}, {"episode_length": 0}, {"image_size": 8}, {"image_size": 1024}, {"seed": -1}, {"workers": 0}],
)
def test_options_out_of_range_are_named(tmp_path, option):
    name, value = next(iter(option.items()))
    with pytest.raises(UserError, match=f"{name}={value}: must be at"):
        collect_robot_arm(tmp_path / "x.h5", **{**SMALL, **option})
    assert not list(tmp_path.iterdir())


def test_an_existing_file_is_kept(tmp_path):
    taken = tmp_path / "x.h5"
    taken.write_text("mine")
    with pytest.raises(UserError, match="exists already"):
        collect_robot_arm(taken, **SMALL)
    assert taken.read_text() == "mine" and len(list(tmp_path.iterdir())) == 1


def test_a_workers_error_reaches_the_caller_and_leaves_no_file(tmp_path):
    videos = tmp_path / "videos"
    videos.mkdir()
    for name in ("a.mp4", "b.mp4"):
        (videos / name).write_bytes(b"damaged")
    with pytest.raises(UserError, match=r"[ab]\.mp4: not a readable video"):
        collect_robot_arm(tmp_path / "x.h5", **{**SMALL, "distractors": str(videos), "workers": 1})
    assert [p.name for p in tmp_path.iterdir()] == ["videos"]


def test_interrupted_script_without_main_guard_leaves_nothing(tmp_path):
    script = tmp_path / "script.py"
    script.write_text(
        "import signal\n"
        "from repdib_lightning.environments.collect_robot_arm import collect_robot_arm\n"
        "signal.signal(signal.SIGINT, signal.default_int_handler)  # whoever runs the tests may ignore it\n"
        "print('started', flush=True)\n"
        "collect_robot_arm('out/x.h5', samples=100_000, episode_length=5, image_size=16, workers=1)\n"
    )
    process = subprocess.Popen(
        [sys.executable, str(script)], cwd=tmp_path, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
        start_new_session=True, env={**os.environ, "TQDM_MININTERVAL": "0"},
    )  # fmt: skip
    shown = ""
    while "5/100000" not in shown and process.poll() is None:  # the bar: an episode has arrived
        shown += process.stderr.read(1)
    assert list((tmp_path / "out").iterdir()), shown
    os.killpg(process.pid, signal.SIGINT)
    output, error = process.communicate(timeout=20)
    assert process.returncode != 0 and "KeyboardInterrupt" in error
    assert output.count("started") == 1, "workers must not run the script again"
    deadline = time.monotonic() + 5
    while list((tmp_path / "out").iterdir()) and time.monotonic() < deadline:
        time.sleep(0.05)
    assert not list((tmp_path / "out").iterdir())
