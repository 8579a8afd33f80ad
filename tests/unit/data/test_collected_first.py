"""Data modules that collect their file where it is absent, and say where."""

import json
from pathlib import Path

import pytest

from repdib_lightning.data.datamodule import EpisodeDataModule
from repdib_lightning.data.mazes import MazeDataModule
from repdib_lightning.data.robot_arm import RobotArmDataModule
from repdib_lightning.errors import UserError

COLLECTORS = "repdib_lightning.environments.collect_"


@pytest.mark.parametrize(
    ("kind", "collector", "what"),
    [
        (MazeDataModule, "maze.collect_maze", "GridWorld"),
        (RobotArmDataModule, "robot_arm.collect_robot_arm", "the robot arm"),
    ],
)
def test_a_mistyped_path_shows_before_minutes_are_spent_on_it(tmp_path, monkeypatch, capsys, kind, collector, what):
    said = []

    def collect(path: Path, **_: object) -> None:
        said.append(capsys.readouterr().err)
        path.touch()

    monkeypatch.setattr(COLLECTORS + collector, collect)
    path = tmp_path / "gridwrld.h5"
    data = kind(str(path))
    data.prepare_data()
    assert said == [f"{path}: no such file; collecting {what} there\n"]
    data.prepare_data()
    assert len(said) == 1 and capsys.readouterr().err == ""


def test_any_store_may_be_collected_by_words_of_a_command(tmp_path, capsys):
    path = tmp_path / "maze.h5"
    words = "maze --world 'SpiralWorld' --samples 60 --episode_length 12 --progress false"
    data = EpisodeDataModule(str(path), horizon=2, collect=words)
    data.prepare_data()
    assert capsys.readouterr().err.startswith(f"{path}: no such file; collecting {words} there")
    data.setup()
    assert json.loads(data.store.attributes["configuration"])["world"] == "SpiralWorld"
    before = path.stat().st_mtime_ns
    data.prepare_data()
    assert path.stat().st_mtime_ns == before
    EpisodeDataModule(str(tmp_path / "none.h5"), collect=" ").prepare_data()
    with pytest.raises(UserError, match="unknown environment 'mase', did you mean 'maze'"):
        EpisodeDataModule(str(tmp_path / "none.h5"), collect="mase").prepare_data()
