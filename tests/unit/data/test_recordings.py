"""Clips of one recording: written, resumed, hashed, repacked, and on one side of every split."""

import hashlib

import h5py
import numpy as np
import pytest
from clip_stores import write_clips

from repdib_lightning.data.episodes import EpisodeStore
from repdib_lightning.data.fingerprint import recompute_fingerprint
from repdib_lightning.data.importers.repack import import_store
from repdib_lightning.data.sampling import FutureSampling
from repdib_lightning.data.writer import EpisodeWriter
from repdib_lightning.errors import UserError
from repdib_lightning.evaluation.splits import split_evaluation
from repdib_lightning.records import ArraySpec

NUMBERS = (7, 7, 3, 0, 3, 2**40)


def writer(path, **options):
    stated = {"rows": 6, "episodes": 6, "observations": {"eye": ArraySpec((4,), "float32")}, "actions": None}
    return EpisodeWriter(path, **{**stated, "recordings": True, **options})


def add(opened, numbers=NUMBERS, stop=None):
    for number in list(numbers)[opened.episodes_done : stop]:
        readings = np.full((1, 4), opened.episodes_done, np.float32)
        opened.add_episode(observations={"eye": readings}, recording=number)


def whole(path, numbers=NUMBERS, **options):
    with writer(path, **options) as opened:
        add(opened, numbers)
    return EpisodeStore(path)


def test_numbers_come_back(tmp_path):
    store = whole(tmp_path / "a.h5")
    assert store.recordings.tolist() == list(NUMBERS) and store.recordings.dtype == np.int64
    assert store.row_recordings.tolist() == list(NUMBERS)
    assert recompute_fingerprint(store) == store.fingerprint


def test_a_store_without_them_has_one_recording_an_episode(store_file):
    store = EpisodeStore(store_file)
    assert store.recordings.tolist() == [0, 1, 2, 3] and "episodes/recording" not in store
    assert np.array_equal(store.row_recordings, store.row_episodes)


def test_the_fingerprint_counts_them_where_they_are(tmp_path):
    first, other = whole(tmp_path / "a.h5"), whole(tmp_path / "b.h5", (7, 7, 3, 1, 3, 2**40))
    again = whole(tmp_path / "c.h5", [None] * 6, recordings=False)
    assert len({first.fingerprint, other.fingerprint, again.fingerprint}) == 3
    content = hashlib.blake2b(digest_size=16)  # as before there were any
    for number in range(6):
        content.update(b"1 False" + b"observations/eye" + np.full((1, 4), number, np.float32).tobytes())
    assert again.fingerprint == content.hexdigest()


@pytest.mark.parametrize("done", range(7))
def test_the_same_bytes_after_an_interruption(tmp_path, done):
    whole(tmp_path / "whole.h5")
    path = tmp_path / "x.h5"
    with pytest.raises(KeyboardInterrupt), writer(path, resume=True) as opened:
        add(opened, stop=done)
        raise KeyboardInterrupt
    with writer(path, resume=True) as opened:
        assert opened.episodes_done == done
        add(opened)
    assert path.read_bytes() == (tmp_path / "whole.h5").read_bytes()


def test_an_unfinished_one_without_them_is_another(tmp_path):
    path = tmp_path / "x.h5"
    with pytest.raises(KeyboardInterrupt), writer(path, resume=True, recordings=False):
        raise KeyboardInterrupt
    with pytest.raises(UserError, match=r"other options: episodes/recording was absent, is scalar int64"):
        writer(path, resume=True)


@pytest.mark.parametrize(
    ("options", "number", "message"),
    [
        ({}, None, r"episode 0: recording is None; expected a whole number"),
        ({}, -1, r"recording is -1; expected a whole number of at least 0"),
        ({}, 1.0, r"recording is 1\.0; expected"),
        ({}, True, r"recording is True; expected"),
        ({}, 2**63, r"expected a whole number"),
        ({"recordings": False}, 3, r"recording is 3, but the writer was made without recordings=True"),
    ],
)
def test_misuse_is_one_line(tmp_path, options, number, message):
    with pytest.raises(UserError, match=message), writer(tmp_path / "a.h5", **options) as opened:
        add(opened, [number])
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        (np.zeros(5, np.int64), r"'episodes/recording' \(5\) and 'episodes/length' \(6\) disagree"),
        (np.zeros(6), r"'episodes/recording' must be \(E,\) integers, is \(6,\) float64"),
    ],
)
def test_hand_written_numbers_are_checked(tmp_path, wrong, message):
    whole(tmp_path / "a.h5")
    with h5py.File(tmp_path / "a.h5", "r+") as file:
        del file["episodes/recording"]
        file["episodes/recording"] = wrong
    with pytest.raises(UserError, match=message):
        EpisodeStore(tmp_path / "a.h5")


def test_a_repacked_store_keeps_them_and_its_fingerprint(tmp_path):
    store = EpisodeStore(write_clips(tmp_path / "a.h5", clips=12, per_recording=2))
    with h5py.File(tmp_path / "a.h5", "r+") as file:
        values = file["observations/gyroscope"][:]
        del file["observations/gyroscope"]
        file.create_dataset("observations/gyroscope", data=values, compression="gzip", chunks=(5, *values.shape[1:]))
    again = EpisodeStore(import_store(tmp_path / "a.h5", tmp_path / "b.h5", progress=False))
    assert again.contiguous and again.fingerprint == store.fingerprint == recompute_fingerprint(again)
    assert np.array_equal(again.recordings, store.recordings) and again.class_names == store.class_names


@pytest.mark.parametrize("seed", range(20))
def test_no_recording_is_on_both_sides_of_any_split(tmp_path, seed):
    random = np.random.default_rng(seed)
    count = int(random.integers(10, 15))
    numbers = random.permutation(np.concatenate([np.arange(count), np.arange(count), random.integers(0, count, 9)]))
    marked = set(random.permutation(count)[: count // 3].tolist()) if seed % 2 else set()
    shape = {"rows": len(numbers), "episodes": len(numbers)}
    with writer(tmp_path / "a.h5", **shape) as opened:
        for number in numbers:
            opened.add_episode(
                observations={"eye": np.zeros((1, 4), np.float32)}, recording=int(number), evaluation=number in marked
            )
    store = EpisodeStore(tmp_path / "a.h5")

    def of(episodes):
        return set(numbers[episodes].tolist())

    train, evaluation = (of(store.episodes(split)) for split in ("train", "evaluation"))
    assert train | evaluation == set(range(count)) and not train & evaluation
    assert evaluation == (marked or {4, 9})
    split = split_evaluation(store)
    fit, score = of(split.fit), of(split.score)
    assert fit | score == evaluation and not fit & score and abs(len(fit) - len(score)) <= 1
    assert sorted([*split.fit, *split.score]) == sorted(store.episodes("evaluation"))


def test_too_few_recordings_for_a_split_say_so(tmp_path):
    store = whole(tmp_path / "a.h5")  # 4 recordings, none of which is the fifth
    with pytest.raises(
        UserError, match=r"has no episode for evaluation \(6 in all\).*at least 5 recordings \(every fi"
    ):
        FutureSampling(store, "evaluation", horizon=1, futures=0, seed=0)
