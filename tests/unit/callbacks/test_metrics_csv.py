"""metrics.csv keeps the earlier part of a resumed run, and drops what will come again."""

from __future__ import annotations

import csv
import os

import pytest

from repdib_lightning.callbacks.metrics_csv import MetricsCSV


def rows(path):
    with open(path, newline="") as file:
        return [{k: v for k, v in row.items() if v} for row in csv.DictReader(file)]


def log(logger, step, **values):
    logger.log_metrics(values, step=step)
    logger.save()


def test_rows_before_the_checkpoint_survive_and_later_ones_are_written_once(tmp_path):
    folder = tmp_path / "run"
    first = MetricsCSV(folder)
    for step in range(5):
        log(first, step, loss=step / 7)
    second = MetricsCSV(folder, resumed_step=3)
    log(second, 3, loss=3 / 7)
    log(second, 4, accuracy=0.5)
    assert [int(row["step"]) for row in rows(folder / "metrics.csv")] == [0, 1, 2, 3, 4]
    assert float(rows(folder / "metrics.csv")[2]["loss"]) == 2 / 7
    assert rows(folder / "metrics.csv")[4]["accuracy"] == "0.5"


def test_a_line_cut_by_a_kill_is_dropped(tmp_path):
    folder = tmp_path / "run"
    first = MetricsCSV(folder)
    log(first, 0, loss=1.0, accuracy=0.5)
    log(first, 1, loss=2.0, accuracy=0.5)
    path = folder / "metrics.csv"
    path.write_text(path.read_text() + "0.2")
    log(MetricsCSV(folder, resumed_step=2), 2, loss=3.0)
    assert [row["step"] for row in rows(path)] == ["0", "1", "2"]


def test_a_new_run_starts_empty(tmp_path):
    log(MetricsCSV(tmp_path / "run"), 0, loss=1.0)
    assert len(rows(tmp_path / "run" / "metrics.csv")) == 1


@pytest.mark.parametrize("moment", ["while it is opened again", "while a new column is added"])
def test_a_kill_loses_nothing(tmp_path, monkeypatch, moment):
    class Killed(BaseException):
        pass

    def kill(*_):
        raise Killed

    folder = tmp_path / "run"
    for step in range(3):
        log(first := MetricsCSV(folder, resumed_step=step), step, loss=1.0)
    before = (folder / "metrics.csv").read_text()
    monkeypatch.setattr(os, "replace", kill)
    with pytest.raises(Killed):
        log(MetricsCSV(folder, resumed_step=3) if "opened" in moment else first, 3, accuracy=0.5)
    assert (folder / "metrics.csv").read_text() == before
