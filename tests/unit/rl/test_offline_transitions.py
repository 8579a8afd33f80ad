"""Transitions against a slow loop over episodes, and batches of them."""

from __future__ import annotations

import h5py
import numpy as np
import pytest
import torch
from offline_stores import write_offline

from repdib_lightning.data.episodes import EpisodeStore
from repdib_lightning.errors import UserError
from repdib_lightning.records import ActionSpec
from repdib_lightning.rl.transitions import TransitionBatches, Transitions


@pytest.fixture(scope="module")
def store(tmp_path_factory):
    return EpisodeStore(write_offline(tmp_path_factory.mktemp("transitions") / "data.h5"))


class RowNumbers:
    """Shows the rows themselves."""

    def rows(self, rows, random):
        return torch.from_numpy(rows.copy())


def slow_transitions(store, n_steps, gamma):
    """Row -> (later row, return, discount), one step after the other."""
    rewards, ends = store.array("rewards")[:], store.array("terminations")[:]
    found = {}
    for episode in store.episodes("train"):
        first, length = int(store.starts[episode]), int(store.lengths[episode])
        for step in range(length - 1):
            total, discount, now = 0.0, 1.0, first + step
            for _ in range(n_steps):
                total += discount * float(rewards[now])
                discount *= 0.0 if ends[now] else gamma
                now += 1
                if now == first + length - 1:
                    break
            found[first + step] = (now, total, discount)
    return found


@pytest.mark.parametrize("n_steps", [1, 2, 3, 5, 50])
@pytest.mark.parametrize("gamma", [0.9, 1.0, 0.0])
def test_returns_discounts_and_later_rows_are_those_of_a_slow_loop(store, n_steps, gamma):
    found, wanted = Transitions(store, n_steps=n_steps, gamma=gamma), slow_transitions(store, n_steps, gamma)
    assert found.rows.tolist() == sorted(wanted) and len(found) == len(wanted) == 8 + 1 + 6 + 0 + 7
    later, returns, discounts = map(np.array, zip(*(wanted[row] for row in found.rows), strict=True))
    np.testing.assert_array_equal(found.later, later)
    np.testing.assert_allclose(found.returns, returns, rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(found.discounts, discounts, rtol=1e-6)
    assert found.returns.dtype == found.discounts.dtype == np.float32


def test_only_what_terminated_is_worth_nothing_later(store):
    found = Transitions(store, n_steps=3)
    for episode, length in enumerate(store.lengths):
        inside = store.row_episodes[found.rows] == episode
        ended = found.discounts[inside] == 0.0
        assert ended.sum() == (min(3, length - 1) if episode in (0, 1) else 0)
        assert (store.row_episodes[found.later[inside]] == episode).all()


def test_episodes_for_evaluation_are_left_out(store, tmp_path):
    assert set(store.row_episodes[Transitions(store).rows]) == {0, 1, 3, 5}  # the fourth has no step
    every_fifth = EpisodeStore(write_offline(tmp_path / "b.h5", lengths=[3] * 7, evaluation=()))
    assert set(every_fifth.row_episodes[Transitions(every_fifth).rows]) == {0, 1, 2, 3, 5, 6}


def test_without_rewards_there_is_cloning_and_nothing_else(tmp_path):
    store = EpisodeStore(write_offline(tmp_path / "a.h5", rewards=False))
    with pytest.raises(UserError, match=r"has no 'rewards', which this agent learns from; `finetune bc` needs none$"):
        Transitions(store)
    found = Transitions(store, rewarded=False)
    assert len(found) == 22 and not found.returns.any()


def test_data_that_do_not_say_what_terminated_were_truncated(tmp_path):
    path = write_offline(tmp_path / "a.h5")
    with h5py.File(path, "a") as file:
        del file["terminations"]
    assert Transitions(EpisodeStore(path), n_steps=3).discounts.min() == pytest.approx(0.99**3)


def test_what_stands_at_the_last_row_of_an_episode_is_no_reward(store, tmp_path):
    """No action is taken there; other programs write what they like."""
    path = write_offline(tmp_path / "a.h5")
    with h5py.File(path, "a") as file:
        file["rewards"][store.starts + store.lengths - 1] = 1e6
    found, wanted = (Transitions(s, n_steps=3) for s in (EpisodeStore(path), store))
    np.testing.assert_array_equal(found.returns, wanted.returns)


@pytest.mark.parametrize(
    ("actions", "said"), [(ActionSpec("discrete", 3), "these are discrete"), (None, "there are none")]
)
def test_other_actions_are_refused(tmp_path, actions, said):
    store = EpisodeStore(write_offline(tmp_path / "a.h5", actions=actions))
    with pytest.raises(UserError, match=rf"a\.h5: offline agents need continuous actions, {said}$"):
        Transitions(store)


def test_actions_that_no_actor_gives_are_refused_unless_nobody_trains_on_them(tmp_path):
    store = EpisodeStore(write_offline(tmp_path / "a.h5", largest=1.5))
    with pytest.raises(UserError, match=r"a\.h5: offline agents need actions in \[-1, 1\], here is one of size 1\.4"):
        Transitions(store)
    apart = write_offline(tmp_path / "b.h5", lengths=[4, 4], evaluation=[1])
    with h5py.File(apart, "a") as file:
        file["actions"][5] = 7.0
    assert len(Transitions(EpisodeStore(apart))) == 3


def test_nothing_to_train_on_is_told(tmp_path):
    for lengths, held_out in (([1, 1, 4], [2]), ([5, 5], [0, 1])):
        path = write_offline(tmp_path / f"{len(lengths)}.h5", lengths=lengths, evaluation=held_out)
        with pytest.raises(UserError, match=r"--batch_size 1: .*\.h5 has 0 transitions to train on$"):
            Transitions(EpisodeStore(path)).check_batch(1)


def test_a_batch_holds_what_belongs_together(store):
    transitions = Transitions(store, n_steps=3)
    batches = TransitionBatches(store, transitions, RowNumbers(), 64, 3, seed=5)
    place = {row: number for number, row in enumerate(transitions.rows)}
    for batch in batches:
        places = [place[row] for row in batch.seen.tolist()]
        assert batch.later.tolist() == transitions.later[places].tolist()
        np.testing.assert_array_equal(batch.actions.numpy(), store.gather("actions", transitions.rows[places]))
        np.testing.assert_array_equal(batch.returns.numpy(), transitions.returns[places])
        np.testing.assert_array_equal(batch.discounts.numpy(), transitions.discounts[places])
        assert batch.actions.dtype == batch.returns.dtype == batch.discounts.dtype == torch.float32


def test_a_batch_is_a_function_of_seed_and_number(store):
    def batches(seed, steps=4):
        return TransitionBatches(store, Transitions(store), RowNumbers(), 16, steps, seed)

    in_order = [batch.seen.tolist() for batch in batches(3)]
    assert len(batches(3)) == len(in_order) == 4 and len({tuple(rows) for rows in in_order}) == 4
    fresh = batches(3, steps=100)
    assert [fresh.batch(number).seen.tolist() for number in (2, 0, 3, 1)] == [in_order[n] for n in (2, 0, 3, 1)]
    assert batches(4).batch(0).seen.tolist() != in_order[0]
    assert batches(2**32 - 1).batch(0).seen.tolist() != in_order[0]


def test_every_transition_is_drawn_as_often(store):
    drawn = np.concatenate(
        [batch.seen for batch in TransitionBatches(store, Transitions(store), RowNumbers(), 22, 400, 0)]
    )
    rows, counts = np.unique(drawn, return_counts=True)
    assert rows.tolist() == Transitions(store).rows.tolist()
    assert np.abs(counts - 400).max() < 5 * np.sqrt(400)


def test_a_batch_larger_than_the_data_is_refused(store):
    Transitions(store).check_batch(22)
    with pytest.raises(UserError, match=r"--batch_size 23: .*data\.h5 has 22 transitions to train on$"):
        Transitions(store).check_batch(23)


def rewritten(tmp_path, name, change):
    """A store one of whose arrays another program wrote."""
    path = write_offline(tmp_path / "data.h5")
    with h5py.File(path, "r+") as file:
        array = change(file[name][:])
        del file[name]
        file[name] = array
    return EpisodeStore(path)


@pytest.mark.parametrize("dtype", [np.uint8, np.float32, np.int64])
def test_ends_and_rewards_of_other_types_count_as_they_are(tmp_path, store, dtype):
    other = rewritten(tmp_path, "terminations", lambda array: array.astype(dtype))
    np.testing.assert_array_equal(Transitions(other, n_steps=3).discounts, Transitions(store, n_steps=3).discounts)
    (tmp_path / "data.h5").unlink()
    other = rewritten(tmp_path, "rewards", lambda array: array.astype(np.float64)[:, None])
    np.testing.assert_allclose(Transitions(other, n_steps=3).returns, Transitions(store, n_steps=3).returns, rtol=1e-6)


def test_rewards_that_are_no_numbers_are_named(tmp_path):
    def spoilt(array):
        array[1] = np.nan
        return array

    with pytest.raises(UserError, match=r"data.h5: 'rewards' is NaN or infinite at row 1; 1 such rows"):
        Transitions(rewritten(tmp_path, "rewards", spoilt))
