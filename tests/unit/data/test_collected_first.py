"""Data modules that collect their file where it is absent, and say where."""

from pathlib import Path

import pytest

from repdib_lightning.data.mazes import MazeDataModule
from repdib_lightning.data.robot_arm import RobotArmDataModule

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
