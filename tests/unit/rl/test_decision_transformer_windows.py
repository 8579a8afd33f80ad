"""Windows, returns-to-go and their order against slow loops; data that do not serve."""

from __future__ import annotations

import h5py
import numpy as np
import pytest
from offline_stores import write_offline
from small_choices import random_store

from repdib_lightning.data.episodes import EpisodeStore
from repdib_lightning.data.sampling import stacked_rows
from repdib_lightning.errors import UserError
from repdib_lightning.records import ActionSpec
from repdib_lightning.rl.decision_transformer.windows import WindowOrder, Windows


@pytest.fixture(scope="module")
def store(tmp_path_factory):
    """Episodes of 9, 2, 5 (held out), 14, 0 and 7 steps."""
    return EpisodeStore(random_store(tmp_path_factory.mktemp("windows") / "d.h5", (9, 2, 5, 14, 0, 7)))


def slow(store, context, stride):
    """(row of the first step, time step, steps) of every window."""
    found = []
    for episode in store.episodes("train"):
        steps, begin = int(store.lengths[episode]) - 1, 0
        while steps > 0:
            found.append((int(store.starts[episode]) + begin, begin, min(context, steps - begin)))
            if begin + context >= steps:
                break
            begin += stride
    return found


@pytest.mark.parametrize(("context", "stride"), [(1, 1), (3, 1), (3, 2), (3, 3), (5, 4), (9, 1), (20, 1), (20, 20)])
def test_windows_are_those_of_a_loop(store, context, stride):
    windows = Windows(store, context, stride)
    wanted = slow(store, context, stride)
    assert list(zip(windows.starts, windows.timesteps, windows.lengths, strict=True)) == wanted
    assert sorted(set(windows.timesteps // stride)) == list(range(windows.beginnings))
    rows = windows.rows(np.arange(len(windows)))
    for row, (start, time, steps) in zip(rows, wanted, strict=True):
        assert row.tolist() == [start + min(step, steps - 1) for step in range(context)]
        episode = store.row_episodes[start]
        assert store.starts[episode] + time == start and (store.row_episodes[row] == episode).all()
        assert row.max() < store.starts[episode] + store.lengths[episode] - 1  # never the last row, without an action


@pytest.mark.parametrize("context", [1, 3, 4, 8])
def test_with_a_stride_of_the_context_each_step_comes_once(store, context):
    windows = Windows(store, context, context)
    rows = windows.rows(np.arange(len(windows)))
    covered = np.sort(np.concatenate([row[:n] for row, n in zip(rows, windows.lengths, strict=True)]))
    assert covered.tolist() == np.flatnonzero(windows.trained).tolist() and windows.trained.sum() == 9 + 2 + 14 + 7


@pytest.mark.parametrize("stack", [1, 2, 4])
def test_stacks_are_those_of_single_rows(store, stack):
    windows = Windows(store, 5, 2)
    every = np.arange(len(windows))
    frames = windows.stacked_rows(every, stack)
    assert frames.shape == (len(windows), stack - 1 + 5)
    rows = windows.rows(every)
    for step in range(5):
        real = windows.lengths > step
        wanted = stacked_rows(store, rows[:, step], stack)
        assert frames[real, step : step + stack].tolist() == wanted[real].tolist()


def test_returns_to_go_are_undiscounted_sums_to_the_end(store):
    windows, rewards = Windows(store, 3), store.array("rewards")
    wanted = np.zeros(store.rows)
    for episode in store.episodes("train"):
        start, steps = store.starts[episode], store.lengths[episode] - 1
        for t in range(steps):
            wanted[start + t] = sum(float(rewards[start + later]) for later in range(t, steps))
    assert windows.returns.dtype == np.float32 and windows.actions.dtype == np.int64
    np.testing.assert_allclose(windows.returns, wanted, rtol=1e-5, atol=1e-6)
    first = [store.starts[e] for e in store.episodes("train") if store.lengths[e] > 1]
    assert windows.best_return == pytest.approx(wanted[first].max(), rel=1e-5)


def test_rewards_of_large_episodes_do_not_blur_small_ones(tmp_path):
    path = random_store(tmp_path / "d.h5", (3, 4, 3), ())
    with h5py.File(path, "r+") as file:
        file["rewards"][:] = [0.5, 0.25, 0.25, 0, 1e7, 1e7, 1e7, 1e7, 0, 0.125, 0, 0.5, 0]
    returns = Windows(EpisodeStore(path), 2).returns
    assert returns.tolist() == [1.0, 0.5, 0.25, 0, 4e7, 3e7, 2e7, 1e7, 0, 0.625, 0.5, 0.5, 0]


def test_an_epoch_takes_every_window_once_in_its_own_order():
    order = WindowOrder(23, 5, None, seed=3)
    assert order.batches == 5
    epochs = [np.concatenate([order.batch(5 * epoch + k) for k in range(5)]) for epoch in range(3)]
    assert all(sorted(epoch) == list(range(23)) for epoch in epochs)
    assert len({tuple(epoch) for epoch in epochs}) == 3 and len(order.batch(4)) == len(order.batch(14)) == 3


def test_with_a_number_of_batches_windows_are_drawn_on_across_epochs():
    order = WindowOrder(7, 3, 2, seed=3)
    assert order.batches == 2 and order.samples == 6
    drawn = np.concatenate([order.batch(number) for number in range(7)])
    assert len(drawn) == 21 and all(sorted(drawn[i : i + 7]) == list(range(7)) for i in (0, 7, 14))
    assert len(WindowOrder(2, 5, 1, seed=0).batch(0)) == 5


def test_a_batch_hangs_on_its_number_and_the_seed_alone():
    def batches(seed, numbers):
        order = WindowOrder(50, 8, None, seed)
        return {number: order.batch(number).tolist() for number in numbers}

    assert batches(1, range(14)) == dict(sorted(batches(1, reversed(range(14))).items()))
    assert batches(1, [9]) == {9: batches(1, range(14))[9]} != batches(2, [9])


@pytest.mark.parametrize(
    ("changed", "told"),
    [
        ({"actions": None}, "finetune dt needs discrete actions, there are none"),
        ({"actions": ActionSpec("continuous", 2)}, "finetune dt needs discrete actions, these are continuous"),
        (
            {"actions": ActionSpec("discrete", 4), "rewards": False},
            "has no 'rewards', of which finetune dt makes the returns that it asks for",
        ),
        (
            {"actions": ActionSpec("discrete", 4), "lengths": (1, 1, 4), "evaluation": (2,), "terminated": ()},
            "has no episode with a step to train on (3 episodes)",
        ),
    ],
)
def test_data_that_do_not_serve_are_told(tmp_path, changed, told):
    path = write_offline(tmp_path / "d.h5", **changed)
    with pytest.raises(UserError) as caught:
        Windows(EpisodeStore(path), 3)
    assert str(caught.value) == f"{path}: {told}"


def test_rewards_that_are_no_numbers_are_told_where_they_count(tmp_path):
    path = random_store(tmp_path / "d.h5", (3, 4, 3), (1,))
    with h5py.File(path, "r+") as file:
        rewards = file["rewards"][:]
        rewards[[3, 5]] = np.nan  # behind the last action, and of an episode that is held out
        file["rewards"][:] = rewards
    assert np.isfinite(Windows(EpisodeStore(path), 2).returns).all()
    with h5py.File(path, "r+") as file:
        file["rewards"][[1, 10]] = np.inf
    with pytest.raises(UserError, match=r"d.h5: 'rewards' is NaN or infinite at row 1; 2 such rows$"):
        Windows(EpisodeStore(path), 2)
