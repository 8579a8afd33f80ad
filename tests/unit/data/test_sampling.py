"""Sampling and loading: index arithmetic against explicit loops, and a stream that depends on nothing but numbers."""

from __future__ import annotations

import gc
import weakref

import numpy as np
import pytest
import torch

from repdib_lightning.data.datamodule import EpisodeDataModule
from repdib_lightning.data.episodes import EpisodeStore
from repdib_lightning.data.loading import FutureFrames, ResumableLoader, evaluation_batches
from repdib_lightning.data.sampling import FutureSampling, gather_stacks, stacked_rows
from repdib_lightning.errors import UserError


@pytest.fixture
def store(store_file):
    return EpisodeStore(store_file)


def test_stacks_equal_a_loop_and_stop_at_the_episode_start(store):
    rows = np.arange(store.rows)
    stacks = stacked_rows(store, rows, 3)
    for row in rows:
        first = store.starts[store.row_episodes[row]]
        assert stacks[row].tolist() == [max(first, row - 2), max(first, row - 1), row]
    frames = gather_stacks(store, "front", np.array([13, 15]), 3)
    assert frames.shape == (2, 9, 24, 24)
    assert frames[:, ::3, 0, 0].tolist() == [[13, 13, 13], [13, 14, 15]]


def test_futures_stay_inside_their_episode_and_offsets_are_uniform(store):
    sampling = FutureSampling(store, "train", horizon=4, futures=2, seed=3)
    rows, offsets = sampling.draw(np.arange(40 * len(sampling)))
    assert (offsets[:, 0] == 0).all() and offsets[:, 1:].min() == 1 and offsets[:, 1:].max() == 4
    same = store.row_episodes[rows[:, None] + offsets] == store.row_episodes[rows][:, None]
    assert same.all() and set(store.row_episodes[rows]) == {0, 1}
    share = np.bincount(offsets[:, 1:].ravel())[1:] / offsets[:, 1:].size
    np.testing.assert_allclose(share, 0.25, atol=0.03)


def test_every_epoch_visits_every_anchor_once_in_another_order(store):
    sampling = FutureSampling(store, "train", horizon=4, futures=1, seed=3)
    count = len(sampling)
    first, _ = sampling.draw(np.arange(count))
    second, _ = sampling.draw(np.arange(count, 2 * count))
    assert sorted(first) == sorted(second) == sorted(sampling.anchors)
    assert first.tolist() != second.tolist()
    assert len(sampling.anchors) == (13 - 4) + (9 - 4)


@pytest.mark.parametrize("consecutive", [2, 3, 100])
def test_runs_of_anchors_cut_each_episode_evenly_and_visit_every_anchor_once(store, consecutive):
    alone = FutureSampling(store, "train", horizon=2, futures=1, seed=3)
    runs = FutureSampling(store, "train", horizon=2, futures=1, seed=3, consecutive=consecutive)
    phases = set()
    for epoch in range(6):
        order, _ = runs.draw(np.arange(epoch * len(runs), (epoch + 1) * len(runs)))
        assert sorted(order) == sorted(alone.anchors)
        episodes = store.row_episodes[order]
        broken = np.flatnonzero((np.diff(order) != 1) | (np.diff(episodes) != 0)) + 1
        begins = np.concatenate([[0], broken])
        places = order[begins] - store.starts[episodes[begins]]
        for episode in np.unique(episodes):
            inside = places[(episodes[begins] == episode) & (places > 0)]
            assert len({int(place) % consecutive for place in inside}) <= 1
            phases |= {int(place) % consecutive for place in inside}
        assert max(np.diff(begins, append=len(order))) >= min(consecutive, 4), "and keep together what follows"
    assert consecutive == 100 or len(phases) == consecutive, "runs begin elsewhere in other epochs"


def test_a_sample_is_a_function_of_seed_and_number(store):
    numbers = np.array([41, 3, 17, 90])
    one, other = (FutureSampling(store, "train", horizon=4, futures=2, seed=3) for _ in range(2))
    rows, offsets = one.draw(numbers)
    for i, number in enumerate(numbers[::-1]):
        row, offset = other.draw(np.array([number]))
        assert row[0] == rows[::-1][i] and (offset[0] == offsets[::-1][i]).all()
    assert FutureSampling(store, "train", horizon=4, futures=2, seed=4).draw(numbers)[0].tolist() != rows.tolist()


def test_an_episode_shorter_than_the_horizon_is_named(store):
    with pytest.raises(
        UserError, match=r"episode 1 has 8 steps, fewer than the horizon 9; .* 8, .* data.leave_out_short$"
    ):
        FutureSampling(store, "train", horizon=9, futures=1, seed=0)


def loader(store, **options):
    sampling = FutureSampling(store, "train", horizon=2, futures=1, seed=1)
    return ResumableLoader(FutureFrames(store, sampling, 1, ["front"]), 4, **options)


def rows_of(batches):
    return [batch.rows.tolist() for batch in batches]


def test_short_episodes_are_left_out_where_that_is_asked_for(tmp_path, make_store, capsys):
    path = make_store(tmp_path / "a.h5", lengths=[9, 3, 8, 4, 9])
    store = EpisodeStore(path)
    with pytest.raises(UserError, match="fewer than the horizon 5"):
        FutureSampling(store, "train", horizon=5, futures=1, seed=0)
    left = FutureSampling(store, "train", horizon=5, futures=1, seed=0, leave_out_short=True)
    kept = [episode for episode in store.episodes("train") if store.lengths[episode] > 5]
    episodes = store.row_episodes[left.anchors]
    assert sorted(set(episodes)) == kept and left.left_out == len(store.episodes("train")) - len(kept)
    assert (left.anchors + 5 < (store.starts + store.lengths)[episodes]).all()
    with pytest.raises(UserError, match=r"no episode has as many steps as the horizon 20; the longest has 8$"):
        FutureSampling(store, "train", horizon=20, futures=1, seed=0, leave_out_short=True)
    EpisodeDataModule(str(path), batch_size=2, horizon=5, leave_out_short=True).setup()
    assert "2 of 5 episodes are no longer than the horizon 5: left out" in capsys.readouterr().err


def test_batches_hold_the_frames_of_their_rows(store):
    batch = next(iter(loader(store)))
    pixels = batch.observations["front"][:, :, 0, 0, 0]
    assert (pixels == batch.rows[:, None] + batch.offsets).all()
    assert (batch.actions == torch.from_numpy(store.gather("actions", batch.rows.numpy()))).all()


def test_workers_change_nothing(store):
    plain, worked = loader(store), loader(store, workers=2)
    for _ in range(3):
        assert rows_of(plain) == rows_of(worked)


@pytest.mark.parametrize("workers", [0, 2])
@pytest.mark.parametrize("consumed", [1, 3, 4, 6])
def test_resumes_after_any_batch(store, workers, consumed):
    whole, broken = loader(store), loader(store, workers=workers)
    wanted = rows_of(whole) + rows_of(whole) + rows_of(whole)
    assert len(whole) == 4
    seen = []
    while len(seen) < consumed:
        for batch in broken:
            seen.append(batch.rows.tolist())
            if len(seen) == consumed:
                break
    resumed = loader(store, workers=workers)
    resumed.load_state_dict(broken.state_dict())
    while len(seen) < 12:
        seen += rows_of(resumed)
    assert seen == wanted


def test_the_global_generator_is_left_alone(store):
    torch.manual_seed(5)
    before = torch.get_rng_state()
    list(loader(store, workers=2))
    assert torch.equal(before, torch.get_rng_state())


def test_a_dropped_loader_frees_its_workers_without_the_garbage_collector(store):
    dropped = loader(store, workers=2)
    next(iter(dropped))
    stream = weakref.ref(dropped._stream)
    gc.disable()
    try:
        del dropped
        assert stream() is None
    finally:
        gc.enable()


def test_ranks_together_see_what_one_process_sees(store):
    alone = rows_of(loader(store))
    shares = [rows_of(loader(store, rank=rank, world_size=2)) for rank in range(2)]
    for whole, left, right in zip(alone, *shares, strict=True):
        assert whole == left + right


@pytest.mark.parametrize(("samples", "batch_size", "ranks"), [(19, 8, 1), (19, 8, 2), (7, 4, 3), (24, 8, 2), (3, 8, 3)])
def test_evaluation_holds_every_sample_once_in_equally_many_batches(samples, batch_size, ranks):
    shares = [evaluation_batches(samples, batch_size, rank, ranks) for rank in range(ranks)]
    assert sorted(number for share in shares for batch in share for number in batch) == list(range(samples))
    assert len({len(share) for share in shares}) == 1
    sizes = [len(batch) for share in shares for batch in share]
    assert min(sizes) > 0 and max(sizes) * ranks < batch_size + ranks


@pytest.mark.parametrize(("samples", "batch_size", "ranks"), [(19, 8, 2), (24, 8, 2), (50, 12, 3), (33, 8, 4)])
def test_processes_together_evaluate_on_the_batches_of_one(samples, batch_size, ranks):
    alone = evaluation_batches(samples, batch_size)
    shares = [evaluation_batches(samples, batch_size, rank, ranks) for rank in range(ranks)]
    for whole, *parts in zip(alone, *shares, strict=True):
        assert sorted(number for part in parts for number in part) == whole
        assert max(map(len, parts)) - min(map(len, parts)) <= 1
    assert max(map(len, alone)) <= batch_size and max(map(len, alone)) - min(map(len, alone)) <= 1


def test_fewer_held_out_samples_than_processes():
    with pytest.raises(UserError, match="1 samples, too few for 2 processes"):
        evaluation_batches(1, 8, 0, 2)


def test_changed_batch_size_is_refused_on_resume(store):
    state = loader(store).state_dict() | {"batch_size": 8}
    with pytest.raises(UserError, match="batch_size was 8"):
        loader(store).load_state_dict(state)


def test_data_module_splits_and_measures(store_file):
    data = EpisodeDataModule(str(store_file), batch_size=4, horizon=2, frame_stack=2, views=["top"])
    data.setup("fit")
    assert data.spec.observations["top"].shape == (6, 24, 24) and list(data.spec.observations) == ["top"]
    assert data.spec.horizon == 2 and data.spec.actions.size == 4
    held_out = [row for batch in data.val_dataloader() for row in batch.rows.tolist()]
    trained = [row for batch in data.train_dataloader() for row in batch.rows.tolist()]
    assert len(held_out) == len(set(held_out)) == (11 - 2) + (12 - 2)
    assert min(held_out) >= 22 > max(trained)
    assert held_out == [row for batch in data.val_dataloader() for row in batch.rows.tolist()]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"batch_size": 0}, "data.batch_size must be at least 1"),
        ({"views": ["frnt"]}, "did you mean 'front'"),
        ({"seed": -1}, "must not be negative"),
    ],
)
def test_bad_options(store_file, options, message):
    with pytest.raises(UserError, match=message):
        EpisodeDataModule(str(store_file), **options).setup()


def test_a_batch_larger_than_the_data(store_file):
    data = EpisodeDataModule(str(store_file), batch_size=500)
    data.setup()
    with pytest.raises(UserError, match="batch_size is 500, the data has"):
        data.train_dataloader()
