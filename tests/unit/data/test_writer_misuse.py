"""Whatever is handed to the writer wrongly is one line, and never a file."""

from __future__ import annotations

import os
import subprocess
import sys

import numpy as np
import pytest

from repdib_lightning.data.episodes import EpisodeStore
from repdib_lightning.data.schema import FactorSpec
from repdib_lightning.data.writer import EpisodeWriter
from repdib_lightning.errors import UserError
from repdib_lightning.records import ActionSpec, ArraySpec

STATED = {
    "rows": 4,
    "episodes": 1,
    "observations": {"eye": ArraySpec((1, 2, 8)), "joints": ArraySpec((2,), "float32")},
    "actions": ActionSpec("discrete", 3),
    "factors": {"cell": FactorSpec("endogenous", "categorical", 4), "light": FactorSpec("exogenous", "continuous")},
    "masks": {"eye": (2, 8)},
    "rewards": True,
}


def episode(**changed):
    given = {
        "observations": {"eye": np.full((4, 1, 2, 8), 7, np.uint8), "joints": np.ones((4, 2), np.float32)},
        "actions": np.array([0, 2, 1]),
        "rewards": np.ones(3),
        "terminations": np.zeros(3, bool),
        "truncations": np.zeros(3, bool),
        "factors": {"cell": np.arange(4), "light": np.ones(4)},
        "masks": {"eye": np.ones((4, 2, 8), bool)},
    }
    for key, value in changed.items():
        given[key] = given[key] | value if isinstance(value, dict) else value
    return given


def test_a_right_episode_and_safe_casts_pass(tmp_path):
    with EpisodeWriter(tmp_path / "x.h5", **STATED) as writer:
        eye = np.full((4, 1, 2, 8), 255, np.int64)
        writer.add_episode(**episode(observations={"eye": eye}, actions=np.array([0, 2, 1], np.uint8)))
    store = EpisodeStore(tmp_path / "x.h5")
    assert (store.array("observations/eye")[:] == 255).all()
    assert store.array("actions").tolist() == [0, 2, 1, -1]


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"observations": {"eye": np.full((4, 1, 2, 8), 0.5)}}, r"'observations/eye' is float64; expected .* uint8"),
        ({"observations": {"eye": np.full((4, 1, 2, 8), 407)}}, r"'observations/eye' holds 407 .* 0\.\.255"),
        ({"observations": {"eye": np.full((4, 2, 8), 7, np.uint8)}}, r"'observations/eye' has shape \(4, 2, 8\)"),
        ({"observations": {"eye": [[1]]}}, "'observations/eye' is of type list; expected a numpy array"),
        ({"observations": {"ear": np.ones(4)}}, "made without 'observations/ear'"),
        ({"observations": {"joints": np.full((4, 2), 1e300)}}, "'observations/joints' holds 1e\\+300"),
        ({"observations": None}, "'observations/eye' is missing"),
        ({"actions": None}, r"'actions' is missing; expected a numpy array of shape \(T - 1,\) int64"),
        ({"actions": np.array([0, 1.7, 1])}, "'actions' is float64"),
        ({"actions": np.array([0, 3, 1])}, r"'actions' holds 3 at row 1; expected integers in 0\.\.2"),
        ({"actions": np.array([0, -1, 1])}, "'actions' holds -1 at row 1"),
        ({"actions": np.zeros(4, int)}, r"'actions' has shape \(4,\).* T = 4"),
        ({"rewards": None}, "'rewards' is missing"),
        ({"terminations": np.array([0, 2, 0])}, "'terminations' holds 2"),
        ({"factors": {"cell": np.arange(4) + 1}}, r"'factors/cell' holds 4 at row 3; expected integers in 0\.\.3"),
        ({"factors": None}, "'factors/cell' is missing"),
        ({"factors": 3}, "factors is of type int"),
        ({"masks": None}, "'masks/eye' is missing"),
        ({"masks": {"eye": np.ones((4, 2, 7), bool)}}, "'masks/eye' has shape"),
        ({"evaluation": "yes"}, "evaluation is 'yes'"),
    ],
)
def test_a_wrong_episode_is_named_and_nothing_is_published(tmp_path, changed, message):
    with (
        pytest.raises(UserError, match=rf"x\.h5: episode 0.*{message}") as caught,
        EpisodeWriter(tmp_path / "x.h5", **STATED) as writer,
    ):
        writer.add_episode(**episode(**changed))
    assert "\n" not in str(caught.value) and os.listdir(tmp_path) == []


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        (
            {"factors": {"cell": FactorSpec("endogenous", "categorical")}},
            "'factors/cell': is categorical with classes=0",
        ),
        ({"factors": {"cell": FactorSpec("endogenus", "continuous")}}, "did you mean 'endogenous'"),
        ({"factors": {"cell": FactorSpec("exogenous", "ordinal")}}, "scale is 'ordinal'"),
        ({"actions": ActionSpec("foo", 3)}, "actions: kind is 'foo'"),
        ({"actions": ActionSpec("discrete", 0)}, "size is 0"),
        ({"observations": {"eye": ArraySpec((2,), "float64")}, "masks": {}}, "'float64', must be uint8 or float32"),
        ({"observations": {"eye": ArraySpec(())}, "masks": {}}, "a scalar is"),
        ({"observations": {}}, "observations is empty"),
        ({"masks": {"ear": (2, 8)}}, "'masks/ear': there is no such observation"),
        ({"rows": 0}, "rows=0"),
        ({"attributes": {"format": "mine"}}, "'format' is set by the writer"),
        ({"attributes": {"x": object()}}, "'x' cannot be written as JSON"),
    ],
)
def test_what_no_reader_would_accept_is_refused_at_once(tmp_path, changed, message):
    with pytest.raises(UserError, match=message):
        EpisodeWriter(tmp_path / "x.h5", **STATED | changed)
    assert os.listdir(tmp_path) == []


def test_too_little_and_too_much(tmp_path):
    with (
        pytest.raises(UserError, match="not written, 4 rows in 1 episodes were added, 9 rows in 2"),
        EpisodeWriter(tmp_path / "x.h5", **STATED | {"rows": 9, "episodes": 2}) as writer,
    ):
        writer.add_episode(**episode())
    with (
        pytest.raises(UserError, match="episode 1 ends at row 8, but the writer was made for 4 rows in 1 episodes"),
        EpisodeWriter(tmp_path / "x.h5", **STATED) as writer,
    ):
        writer.add_episode(**episode())
        writer.add_episode(**episode())
    with pytest.raises(UserError, match="the writer is closed"):
        writer.add_episode(**episode())
    assert os.listdir(tmp_path) == []


@pytest.mark.parametrize("overwrite", [True, False])
def test_a_folder_is_not_overwritten(tmp_path, overwrite):
    with pytest.raises(UserError, match="is a folder"):
        EpisodeWriter(tmp_path, **STATED, overwrite=overwrite)


def test_leftovers_of_dead_processes_are_swept(tmp_path):
    dead = subprocess.Popen([sys.executable, "-c", ""])
    dead.wait()
    kept = [f".x.h5.tmp-{os.getppid()}", ".x.h5.tmp-notes", f".y.h5.tmp-{dead.pid}"]
    for name in [*kept, f".x.h5.tmp-{dead.pid}"]:
        (tmp_path / name).touch()
    with EpisodeWriter(tmp_path / "x.h5", **STATED) as writer:
        writer.add_episode(**episode())
    assert sorted(os.listdir(tmp_path)) == sorted([*kept, "x.h5"])
