"""Recordings of the mazes: repeatable, true to the rules, never ended by the goal."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from repdib_lightning.__main__ import main
from repdib_lightning.data.episodes import EpisodeStore
from repdib_lightning.data.mazes import MazeDataModule
from repdib_lightning.environments.collect_maze import collect_maze
from repdib_lightning.environments.maze_batch import training_goals
from repdib_lightning.environments.maze_pictures import AGENT, MazePainter
from repdib_lightning.environments.mazes import WORLDS, build_maze
from repdib_lightning.errors import UserError

SMALL = {"samples": 950, "episode_length": 60, "seed": 7, "progress": False}


@pytest.fixture(scope="module", params=WORLDS)
def world(request) -> str:
    return request.param


@pytest.fixture(scope="module")
def path(tmp_path_factory, world) -> Path:
    return collect_maze(tmp_path_factory.mktemp("maze") / "maze.h5", world=world, **SMALL)


@pytest.fixture(scope="module")
def store(path) -> EpisodeStore:
    return EpisodeStore(path)


@pytest.fixture(scope="module")
def amid_clips(tmp_path_factory) -> EpisodeStore:
    path = tmp_path_factory.mktemp("clips") / "maze.h5"
    return EpisodeStore(collect_maze(path, distractors="procedural", goals="none", cell_pixels=3, **SMALL))


def test_the_same_arguments_give_the_same_bytes(path, world, tmp_path):
    again = collect_maze(tmp_path / "again.h5", world=world, **SMALL)
    assert again.read_bytes() == path.read_bytes()
    other = EpisodeStore(collect_maze(tmp_path / "other.h5", world=world, **{**SMALL, "seed": 8}))
    assert not np.array_equal(other.array("actions"), EpisodeStore(path).array("actions"))


def test_backgrounds_repeat_too(amid_clips, tmp_path):
    again = collect_maze(tmp_path / "x.h5", distractors="procedural", goals="none", cell_pixels=3, **SMALL)
    assert again.read_bytes() == amid_clips.path.read_bytes()


def test_layout(store, world):
    assert store.lengths.tolist() == [61] * 15 + [51]
    assert {name: spec.shape for name, spec in store.observations.items()} == {"picture": (3, 30, 30)}
    assert (store.actions_spec.kind, store.actions_spec.size) == ("discrete", 4)
    assert store.attributes["environment"] == "maze"
    configuration = json.loads(store.attributes["configuration"])
    assert (configuration["world"], configuration["samples"], configuration["goals"]) == (world, 950, "")
    kinds = {name: (factor.kind, factor.scale, factor.classes) for name, factor in store.factors.items()}
    assert kinds == {
        "position": ("endogenous", "categorical", 36),
        "goal": ("endogenous", "categorical", 36),
        "time_step": ("exogenous", "continuous", 0),
    }
    assert np.allclose(store.array("factors/time_step"), np.arange(store.rows) / store.rows)


def test_moves_are_the_mazes_and_go_on_at_the_goal(store, world):
    maze = build_maze(world)
    cells, actions, goals = (store.array(name) for name in ("factors/position", "actions", "factors/goal"))
    last = np.zeros(store.rows, bool)
    last[store.starts + store.lengths - 1] = True
    rows = np.flatnonzero(~last)
    assert np.array_equal(cells[rows + 1], maze.neighbours[cells[rows], actions[rows]])
    assert (actions[last] == -1).all()
    on_goal = cells[rows] == goals[rows]
    assert on_goal.any(), "the goal is crossed, within the episode"
    assert (cells[store.starts] != goals[store.starts]).all()
    assert set(actions[rows]) == {0, 1, 2, 3} and np.bincount(actions[rows]).min() > 190


def test_goals_are_those_of_training_and_stay_for_an_episode(store, world):
    goals = store.array("factors/goal")
    assert np.array_equal(goals, np.repeat(goals[store.starts], store.lengths))
    assert set(goals) == set(training_goals(build_maze(world)))
    assert len(set(goals[store.evaluation[store.row_episodes]])) > 1, "those of evaluation episodes too"


def test_pictures_and_masks_show_the_factors(store, world):
    rows = np.arange(store.rows)
    cells, goals = (np.array(store.array(f"factors/{name}")) for name in ("position", "goal"))
    drawn = MazePainter(build_maze(world)).draw(cells, goals)
    assert np.array_equal(store.gather("observations/picture", rows), drawn)
    red = (drawn == np.array(AGENT)[:, None, None]).all(1)
    assert np.array_equal(store.mask("picture", rows), red) and (red.sum(axis=(1, 2)) == 9).all()


def test_about_a_third_is_held_out(store):
    assert store.evaluation.sum() == 5 and store.evaluation.argmax() > 0


def test_evaluation_episodes_show_other_clips(amid_clips):
    held_out = amid_clips.evaluation[amid_clips.row_episodes]
    clips = amid_clips.array("factors/clip")
    assert set(clips[held_out]) <= set(range(48, 64)) and set(clips[~held_out]) <= set(range(48))
    assert np.array_equal(clips, np.repeat(clips[amid_clips.starts], amid_clips.lengths))
    factor = amid_clips.factors["clip"]
    assert (factor.kind, factor.classes) == ("exogenous", 64)
    assert "goal" not in amid_clips.factors


def test_clips_play_behind_the_agent(amid_clips):
    pictures = amid_clips.gather("observations/picture", np.arange(61))
    masks = amid_clips.mask("picture", np.arange(61))
    assert (pictures.transpose(0, 2, 3, 1)[masks] == AGENT).all()
    unmasked = ~(masks[1:] | masks[:-1])
    changed = (pictures[1:] != pictures[:-1]).any(1)
    assert (changed & unmasked).any(axis=(1, 2)).all()


def test_from_the_command_line(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    options = [
        "--world",
        "LoopWorld",
        "--samples",
        "30",
        "--episode_length",
        "10",
        "--seed",
        "3",
        "--goals",
        "centre 0,5",
    ]
    look = ["--distractors", "procedural_images", "--cell_pixels", "4", "--show_walls", "--progress", "false"]
    for _ in range(2):
        assert main(["collect", "maze", "data/m.h5", *options, *look, "--overwrite"]) == 0
    assert "wrote data/m.h5" in capsys.readouterr().out
    store = EpisodeStore("data/m.h5")
    assert store.observations["picture"].shape == (3, 24, 24) and set(store.array("factors/goal")) <= {20, 5}
    assert main(["collect", "maze", "data/m.h5"]) == 2
    assert "exists already" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["--world", "Loop"], "did you mean 'LoopWorld'"),
        (["--samples", "0"], "samples=0: must be at least 1"),
        (["--episode_length", "0"], "episode_length=0: must be at least 1"),
        (["--seed", "-1"], "seed=-1: must be at least 0"),
        (["--goals", "2.5,2"], "goals=2.5,2: lies in a wall"),
        (["--cell_pixels", "2"], "cell_pixels=2: must be from 3"),
        (["--distractors", "nowhere"], "distractors: 'nowhere' is neither"),
        (["--wrld", "LoopWorld"], "did you mean '--world'?"),
    ],
)
def test_a_wrong_option_gets_one_line_and_no_file(options, said, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert main(["collect", "maze", "x.h5", *options]) == 2
    error = capsys.readouterr().err
    assert said in error and error.count("\n") == 1
    assert not list(tmp_path.iterdir())


def test_a_missing_recording_is_collected_first(tmp_path):
    data = MazeDataModule(str(tmp_path / "x.h5"), "SpiralWorld", samples=120, collection_seed=4, batch_size=16)
    data.prepare_data()
    data.setup()
    made = collect_maze(tmp_path / "y.h5", world="SpiralWorld", samples=120, seed=4, progress=False)
    assert (tmp_path / "x.h5").read_bytes() == made.read_bytes()
    assert data.spec.horizon == 2 and data.spec.observations["picture"].shape == (3, 30, 30)
    written = (tmp_path / "x.h5").stat().st_mtime_ns
    data.prepare_data()
    assert (tmp_path / "x.h5").stat().st_mtime_ns == written


@pytest.mark.parametrize(
    ("options", "said"),
    [({"world": "GridWorld"}, "world=SpiralWorld, data.world is GridWorld"), ({"distractors": "procedural"}, "=None")],
)
def test_a_recording_of_something_else_is_refused(options, said, tmp_path):
    path = collect_maze(tmp_path / "x.h5", world="SpiralWorld", samples=120, progress=False)
    with pytest.raises(UserError, match=said):
        MazeDataModule(str(path), **{"world": "SpiralWorld", **options}).setup()
