"""What is written while an online agent learns, and what it saw in the end."""

from __future__ import annotations

import csv

import numpy as np
import pytest
import torch
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from repdib_lightning.evaluation.curves import read_curves
from repdib_lightning.rl.last_good import LastGood, Spoiled, check_sound, told
from repdib_lightning.rl.online_progress import OnlineProgress
from repdib_lightning.rl.online_values import SeenValues


def test_rows_are_of_evaluations_and_columns_come_as_they_are_known(tmp_path):
    asked = []

    def evaluate(last):
        asked.append(last)
        return np.array([1.0, 3.0]) * len(asked)

    progress = OnlineProgress(tmp_path, every=100, total=250, evaluate=evaluate)
    progress.add(0)
    due = [frames for frames in range(8, 251, 8) if progress.is_due(frames) and not progress.add(frames, {"critic": 2})]
    progress.add(250, {"critic": 1.5, "return": 7.0})
    progress.close()
    assert due == [104, 200] and asked == [False, False, False, True]
    with open(tmp_path / "progress.csv", newline="") as file:
        table = list(csv.DictReader(file))
    assert [row["step"] for row in table] == ["0", "104", "200", "250"]
    assert list(table[0]) == ["step", "eval/return", "train/critic", "train/return"]
    assert [row["train/return"] for row in table] == ["", "", "", "7"]
    assert progress.returns.tolist() == [4.0, 12.0] and progress.curve("eval/return").tolist() == [2, 4, 6, 8]
    assert read_curves(tmp_path / "progress.csv")["train/critic"].tolist() == [[104, 2], [200, 2], [250, 1.5]]
    log = EventAccumulator(str(tmp_path)).Reload()
    assert [scalar.step for scalar in log.Scalars("eval/return")] == [0, 104, 200, 250]
    assert [scalar.step for scalar in log.Scalars("train/rate")] == [104, 200, 250]
    assert all(scalar.value > 0 for scalar in log.Scalars("train/rate"))


def test_evaluations_more_often_than_updates_are_made_once(tmp_path):
    progress = OnlineProgress(tmp_path, every=10, total=100, evaluate=lambda last: np.ones(1))
    progress.add(0)
    assert not progress.is_due(0) and not progress.is_due(9)
    assert progress.is_due(55)
    progress.add(55)
    assert not progress.is_due(59) and progress.is_due(60) and not progress.is_due(100)
    progress.close()


@pytest.mark.parametrize(("width", "rows"), [(4, 1000), (1024, 462)])
def test_values_are_of_rows_spread_over_all_and_stay_small(tmp_path, width, rows):
    seen, random = SeenValues(), torch.Generator().manual_seed(0)
    for first in range(0, 2500, 10):
        latents = torch.rand(10, width, generator=random)
        latents[:, 0] = torch.arange(first, first + 10)
        seen.add(latents, latents[:, 0] / 3)
    seen.save(tmp_path / "values.npz")
    assert (tmp_path / "values.npz").stat().st_size < 1_000_000
    kept = np.load(tmp_path / "values.npz")
    assert kept["latents"].shape == (rows, width) and kept["values"].shape == (rows,)
    numbers = kept["values"] * 3
    np.testing.assert_allclose(kept["latents"][:, 0], numbers, rtol=1e-3)  # of the same rows
    assert round(numbers[0]) == 0 and round(numbers[-1]) == 2499 and np.ptp(np.diff(numbers)) < 1.01


def test_of_a_short_evaluation_every_row_is_kept(tmp_path):
    seen = SeenValues()
    seen.add(torch.ones(3, 4), torch.arange(3))
    seen.save(tmp_path / "values.npz")
    assert np.load(tmp_path / "values.npz")["values"].tolist() == [0, 1, 2]


def test_what_is_kept_is_what_was_accepted_last():
    layer = torch.nn.BatchNorm1d(2)  # weights, running means and a counter
    good = LastGood([layer])
    layer.weight.data.fill_(2.0)
    layer.num_batches_tracked += 3
    good.offer()
    good.accept()
    layer.weight.data.fill_(3.0)
    good.offer()  # of which nobody says that it was good
    layer.weight.data.fill_(float("nan"))
    layer.running_mean.fill_(float("nan"))
    good.restore()
    assert layer.weight.tolist() == [2.0, 2.0] and layer.running_mean.tolist() == [0.0, 0.0]
    assert layer.num_batches_tracked == 3


@pytest.mark.parametrize(
    ("values", "said"),
    [
        ({"critic": float("nan")}, "train/critic is nan"),
        ({"critic": 1.0, "value": float("-inf")}, "train/value is -inf"),
        ({"value": -101.0}, "train/value is -101, beyond --value_limit 100"),
        ({"actor": 2e5}, "train/actor is 2e\\+05, beyond --value_limit 100"),
    ],
)
def test_what_is_not_sound(values, said, tmp_path):
    with pytest.raises(Spoiled, match=said) as spoiled:
        check_sound(values, 100.0)
    line = str(told(spoiled.value, 4000, tmp_path / "p.safetensors"))
    assert "after 4000 frames" in line and "p.safetensors holds the policy of before" in line


def test_a_large_loss_alone_is_sound():
    check_sound({"critic": 1e9, "value": -99.0, "actor": 99.0}, 100.0)
