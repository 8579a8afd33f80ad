"""What is drawn while a replay grows, against what the finished store says; and where an interrupted one goes on."""

from __future__ import annotations

import errno
import os
import re

import numpy as np
import pytest
import torch
from small_worlds import plan
from telling_world import ACTIONS, PICTURE, STEPS

from repdib_lightning.data import growing
from repdib_lightning.data.episodes import EpisodeStore
from repdib_lightning.data.fingerprint import recompute_fingerprint
from repdib_lightning.errors import UserError
from repdib_lightning.records import ArraySpec
from repdib_lightning.rl.exploration.replay import Replay

ROWS = STEPS + 1


def episode(number):
    """The first pixel tells the row of the finished store; everything else is random."""
    random = np.random.default_rng(number)
    pixels = random.integers(0, 256, (ROWS, *PICTURE), dtype=np.uint8)
    pixels[:, 0, 0, 0] = number * ROWS + np.arange(ROWS)
    return {
        "observations": {"pixels": pixels},
        "actions": random.uniform(-1, 1, (STEPS, ACTIONS)).astype(np.float32),
        "rewards": random.normal(size=STEPS).astype(np.float32),
        "factors": {"sum": random.normal(size=(ROWS, ACTIONS)), "clock": random.normal(size=ROWS)},
    }


def replay(path, episodes=7, hold_out_every=0, **options):
    return Replay(path, plan(episodes, hold_out_every=hold_out_every), **options)


def filled(path, count, episodes=7, **options):
    made = replay(path, episodes, **options)
    for number in range(made.episodes, count):
        made.add(episode(number))
    return made


@pytest.fixture
def store(tmp_path):
    """All of it, finished."""
    made = filled(tmp_path / "finished.h5", 7)
    made.finish()
    made.close()
    return EpisodeStore(tmp_path / "finished.h5")


def slow(store, row, n_steps, gamma, stack):
    """Both stacks, m, return and discount of a row, one step after the other."""
    pixels, rewards = store.array("observations/pixels"), store.array("rewards")
    first = row // ROWS * ROWS
    total, discount, now = 0.0, 1.0, row
    for _ in range(n_steps):
        total, discount, now = total + discount * float(rewards[now]), discount * gamma, now + 1
        if now == first + STEPS:
            break
    both = [np.concatenate([pixels[max(last - back, first)] for back in range(stack)][::-1]) for last in (row, now)]
    return np.stack(both), now - row, total, discount


@pytest.mark.parametrize("stack", [1, 3])
@pytest.mark.parametrize(("n_steps", "gamma"), [(1, 0.99), (3, 0.9), (5, 1.0), (50, 0.5), (2, 0.0)])
def test_a_batch_is_that_of_a_slow_loop_over_the_store(tmp_path, store, n_steps, gamma, stack):
    made = filled(tmp_path / "x.h5", 5, n_steps=n_steps, gamma=gamma, frame_stack=stack)
    batch = made.draw(3, 25)
    assert batch.observations["pixels"].shape == (25, 2, 3 * stack, *PICTURE[1:])
    assert len(set(batch.rows.tolist())) > 8
    for place, row in enumerate(batch.rows.tolist()):
        pixels, ahead, total, discount = slow(store, row, n_steps, gamma, stack)
        np.testing.assert_array_equal(batch.observations["pixels"][place], pixels)
        assert batch.offsets[place].tolist() == [0, ahead] and 1 <= ahead <= n_steps
        np.testing.assert_array_equal(batch.actions[place], store.array("actions")[row])
        assert float(batch.returns[place]) == pytest.approx(total, rel=1e-5, abs=1e-6)
        assert float(batch.discounts[place]) == pytest.approx(discount)
    assert batch.returns.dtype == batch.discounts.dtype == batch.actions.dtype == torch.float32


def drawn_rows(made, batches=60, size=20):
    return np.concatenate([made.draw(number, min(size, len(made))).rows.numpy() for number in range(batches)])


@pytest.mark.parametrize("hold_out_every", [0, 2, 3, 7])
@pytest.mark.parametrize("count", [1, 2, 3, 6, 7])
def test_all_steps_of_whole_training_episodes_are_drawn_and_nothing_else(tmp_path, hold_out_every, count):
    made = filled(tmp_path / "x.h5", count, hold_out_every=hold_out_every)
    training = [e for e in range(count) if not hold_out_every or e % hold_out_every != hold_out_every - 1]
    assert [e for e in range(count) if not made.plan.is_held_out(e)] == training
    assert len(made) == len(training) * STEPS
    wanted = {e * ROWS + step for e in training for step in range(STEPS)}
    assert set(drawn_rows(made).tolist()) == wanted


def test_rows_are_drawn_evenly(tmp_path):
    rows = drawn_rows(filled(tmp_path / "x.h5", 3), batches=1000)
    counts = np.bincount(rows)
    counts = counts[counts > 0]
    assert len(counts) == 3 * STEPS and counts.min() > 0.9 * counts.mean() and counts.max() < 1.1 * counts.mean()


def test_held_out_episodes_are_marked(tmp_path):
    made = filled(tmp_path / "x.h5", 7, hold_out_every=3)
    made.finish()
    store = EpisodeStore(tmp_path / "x.h5")
    assert store.evaluation.tolist() == [False, False, True, False, False, True, False]
    assert recompute_fingerprint(store) == store.fingerprint
    assert store.array("truncations").reshape(7, ROWS)[:, STEPS - 1].all() and store.array("truncations").sum() == 7
    assert not store.array("terminations").any()
    assert set(store.lengths) == {ROWS} and not list(tmp_path.glob(".*"))


def equal(one, other):
    return all(
        torch.equal(a, b)
        for a, b in (
            (one.observations["pixels"], other.observations["pixels"]),
            *((getattr(one, name), getattr(other, name)) for name in ("rows", "actions", "returns", "discounts")),
        )
    )


def test_a_batch_is_a_function_of_seed_number_and_episodes(tmp_path):
    made, same = filled(tmp_path / "a.h5", 3, seed=5), filled(tmp_path / "b.h5", 3, seed=5)
    torch.manual_seed(0)
    first = made.draw(9, 8)
    made.draw(2, 4)
    torch.manual_seed(1)
    np.random.seed(3)  # noqa: NPY002 (whatever is drawn elsewhere)
    assert equal(made.draw(9, 8), first) and equal(same.draw(9, 8), first)
    assert not equal(made.draw(10, 8), first)
    assert not equal(filled(tmp_path / "c.h5", 3, seed=6).draw(9, 8), first)
    same.add(episode(3))
    assert not equal(same.draw(9, 8), first)


@pytest.mark.parametrize("seed", [0, 2**32, 2**64 - 1])
def test_any_seed_will_do(tmp_path, seed):
    assert len(filled(tmp_path / "a.h5", 3, seed=seed).draw(2**40, 15)) == 15


@pytest.mark.parametrize(("count", "size"), [(0, 1), (1, STEPS + 1), (3, 2 * STEPS + 1)])
def test_too_few_transitions_are_told(tmp_path, count, size):
    made = filled(tmp_path / "x.h5", count, hold_out_every=3)
    with pytest.raises(UserError, match=rf"x\.h5: holds {min(count, 2) * STEPS} transitions, a batch of {size} "):
        made.draw(0, size)


@pytest.mark.parametrize("keep", [0, 1, 4])
@pytest.mark.parametrize("there", [4, 6, 7])
def test_going_on_gives_the_bytes_of_an_uninterrupted_file(tmp_path, store, keep, there):
    path = tmp_path / "x.h5"
    first = replay(path)
    for number in range(there):  # later ones are other than they will be
        first.add(episode(number if number < keep else 50 + number))
    first.close()
    made = filled(path, 7, keep=keep)
    assert made.episodes == 7
    made.finish()
    assert path.read_bytes() == store.path.read_bytes()


def test_batches_of_a_replay_that_went_on_are_the_same(tmp_path):
    first = filled(tmp_path / "x.h5", 6, hold_out_every=3, frame_stack=2)
    first.close()
    made = replay(tmp_path / "x.h5", hold_out_every=3, frame_stack=2, keep=4)
    whole = filled(tmp_path / "y.h5", 4, hold_out_every=3, frame_stack=2)
    assert (made.episodes, len(made)) == (whole.episodes, len(whole)) == (4, 3 * STEPS)
    for number in range(5):
        assert equal(made.draw(number, 12), whole.draw(number, 12))


@pytest.mark.parametrize(("there", "keep"), [(0, 1), (3, 4), (2, 99)])
def test_fewer_episodes_than_are_to_be_kept_are_told(tmp_path, there, keep):
    filled(tmp_path / "x.h5", there).close()
    said = rf"\.x\.h5\.partial: holds {there} episodes, {keep} are to be gone on with$"
    for _ in range(2):  # nothing is lost by it, nor locked
        with pytest.raises(UserError, match=said):
            replay(tmp_path / "x.h5", keep=keep)
    assert replay(tmp_path / "x.h5", keep=there).episodes == there


def test_another_plan_is_told(tmp_path):
    filled(tmp_path / "x.h5", 2).close()
    with pytest.raises(UserError, match=r"unfinished recording with other options: .*rows was 42, is 48"):
        replay(tmp_path / "x.h5", episodes=8, keep=2)


def test_a_new_run_begins_anew(tmp_path):
    filled(tmp_path / "x.h5", 4).close()
    assert replay(tmp_path / "x.h5").episodes == 0


def test_what_is_not_whole_is_not_published(tmp_path):
    made = filled(tmp_path / "x.h5", 6)
    with pytest.raises(UserError, match="36 rows in 6 episodes were added"):
        made.finish()
    assert not (tmp_path / "x.h5").exists()
    assert replay(tmp_path / "x.h5", keep=6).episodes == 6


def test_a_replay_in_use_is_kept_from_others(tmp_path):
    made = filled(tmp_path / "x.h5", 2)
    with pytest.raises(UserError, match="another process is writing"):
        replay(tmp_path / "x.h5", keep=2)
    made.add(episode(2))
    assert made.draw(0, 15).rows.max() >= 2 * ROWS


def test_reading_more_than_is_held_in_memory_still_gives_the_right_rows(tmp_path, store, monkeypatch):
    monkeypatch.setattr(growing, "_RESIDENT", 500)
    made = filled(tmp_path / "x.h5", 3, frame_stack=2)
    for number in range(8):
        batch = made.draw(number, 15)
        for place, row in enumerate(batch.rows.tolist()):
            np.testing.assert_array_equal(batch.observations["pixels"][place], slow(store, row, 3, 0.99, 2)[0])
        if number == 4:
            made.add(episode(3))
    assert made._arrays._mapped_bytes <= 500


def test_one_gather_gives_back_what_huge_pages_map_for_its_rows(tmp_path, monkeypatch):
    """A row may have a huge page mapped: what a batch of a big replay touches would be gigabytes."""
    made = filled(tmp_path / "x.h5", 3)
    arrays, given_back = made._arrays, []

    class Whole:
        def madvise(self, advice):
            given_back.append(advice)

    size = arrays._arrays["observations/pixels"].nbytes
    monkeypatch.setattr(growing, "_HUGE", size // 10)
    monkeypatch.setattr(growing, "_RESIDENT", size // 4)
    monkeypatch.setattr(arrays, "_whole", Whole())
    rows = np.array([0, 17, 3, 3, 9, 12, 1, 16, 8, 2])
    np.testing.assert_array_equal(arrays.gather("observations/pixels", rows)[:, 0, 0, 0], rows)
    assert len(given_back) == 2, "after each four rows, two of which are read at once"


def test_a_full_disk_names_the_command_that_goes_on(tmp_path, monkeypatch):
    made = filled(tmp_path / "replay.h5", 2)

    def pwrite(handle, content, offset):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(os, "pwrite", pwrite)
    told = rf"cannot be written \(No space.*2 of 7 episodes are kept, fit --resume {re.escape(str(tmp_path))} goes on"
    with pytest.raises(UserError, match=told):
        made.add(episode(2))


def test_gather_takes_whole_episodes_or_places(tmp_path, store):
    made = filled(tmp_path / "x.h5", 4)
    for key in ("observations/pixels", "factors/sum", "factors/clock"):
        rows = store.array(key)[2 * ROWS : 3 * ROWS]
        np.testing.assert_array_equal(made.gather(key, 2), rows)
        np.testing.assert_array_equal(made.gather(key, 2, np.array([5, 0, 0])), rows[[5, 0, 0]])


def test_several_observations_and_vectors(tmp_path):
    shapes = {"eye": ArraySpec((1, 2, 3)), "joints": ArraySpec((4,), "float32")}
    made = Replay(tmp_path / "x.h5", plan(2, observations=shapes), frame_stack=2)
    content = episode(0) | {
        "observations": {
            "eye": np.arange(ROWS * 6, dtype=np.uint8).reshape(ROWS, 1, 2, 3),
            "joints": np.arange(ROWS * 4, dtype=np.float32).reshape(ROWS, 4),
        }
    }
    made.add(content)
    batch = made.draw(0, 5)
    eye, joints = batch.observations["eye"], batch.observations["joints"]
    assert eye.shape == (5, 2, 2, 2, 3) and joints.shape == (5, 2, 8) and joints.dtype == torch.float32
    later = batch.offsets[:, 1] + batch.rows
    assert joints[:, 0, 4].tolist() == (4 * batch.rows).tolist() and joints[:, 1, 4].tolist() == (4 * later).tolist()
    assert joints[:, 0, 0].tolist() == [max(0, 4 * (row - 1)) for row in batch.rows.tolist()]
    assert eye[:, 1, 1, 0, 0].tolist() == (6 * later).tolist()
