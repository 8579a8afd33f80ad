"""Rows are read while a store is written, and a recording goes on after the episodes that it is told to keep."""

from __future__ import annotations

import multiprocessing
import os
import sys
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parents[2] / "integration"))
from recording_child import LENGTHS, episode, record, writer

from repdib_lightning.data import growing
from repdib_lightning.data.episodes import EpisodeStore
from repdib_lightning.errors import UserError

KEYS = (
    *("observations/eye", "observations/joints", "actions", "rewards", "terminations", "truncations"),
    *("factors/cell", "factors/light"),
)
REPEATS = 3
COUNT = REPEATS * len(LENGTHS)


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    path = tmp_path_factory.mktemp("whole") / "x.h5"
    record(path, repeats=REPEATS, resume=False)
    return path


def rows_done(count):
    return sum(LENGTHS[number % len(LENGTHS)] for number in range(count))


@pytest.mark.parametrize("resume", [True, False])
@pytest.mark.parametrize("resident", [2**28, 100])
def test_every_row_is_there_once_its_episode_is_added(tmp_path, whole, resume, resident, monkeypatch):
    monkeypatch.setattr(growing, "_RESIDENT", resident)
    store = EpisodeStore(whole)
    opened = writer(tmp_path / "x.h5", repeats=REPEATS, resume=resume)
    arrays = opened.arrays()
    random = np.random.default_rng(0)
    for number in range(COUNT):
        opened.add_episode(**episode(number))
        rows = random.integers(rows_done(number + 1), size=40)  # in any order, with repeats
        for key in KEYS:
            found, wanted = arrays.gather(key, rows), store.array(key)
            np.testing.assert_array_equal(found, wanted[rows], err_msg=key)
            assert found.dtype == wanted.dtype and found.flags.writeable
    opened.close()


def test_what_is_read_is_a_copy_and_none_is_read_of_none(tmp_path):
    opened = writer(tmp_path / "x.h5")
    opened.add_episode(**episode(0))
    arrays = opened.arrays()
    first = arrays.gather("observations/eye", np.array([0]))
    first += 1
    assert not np.array_equal(arrays.gather("observations/eye", np.array([0])), first)
    assert arrays.gather("observations/eye", np.zeros(0, np.int64)).shape == (0, 3, 9, 9)
    with pytest.raises(IndexError):
        arrays.gather("rewards", np.array([sum(LENGTHS)]))
    opened.close()


@pytest.mark.parametrize("there", [0, 1, 4, COUNT])
@pytest.mark.parametrize("keep", [None, 0, 1, 3, 4, COUNT])
def test_a_recording_goes_on_after_the_episodes_that_are_kept(tmp_path, whole, there, keep):
    path = tmp_path / "x.h5"
    opened = writer(path, repeats=REPEATS)
    for number in range(there):
        opened.add_episode(**episode(number, seed=0 if keep is None or number < keep else 1))
    opened.close()
    if keep is not None and keep > there:
        with pytest.raises(UserError, match=rf"\.partial: holds {there} episodes, {keep} are to be gone on with$"):
            writer(path, repeats=REPEATS, keep=keep)
        return
    with writer(path, repeats=REPEATS, keep=keep) as opened:
        assert opened.episodes_done == (there if keep is None else keep)
        for number in range(opened.episodes_done, COUNT):
            opened.add_episode(**episode(number))
    assert path.read_bytes() == whole.read_bytes()


def test_what_is_forgotten_stays_forgotten(tmp_path):
    path = tmp_path / "x.h5"
    opened = writer(path, repeats=REPEATS)
    for number in range(5):
        opened.add_episode(**episode(number))
    opened.close()
    writer(path, repeats=REPEATS, keep=2).close()
    assert writer(path, repeats=REPEATS).episodes_done == 2


def test_keeping_needs_a_recording_that_is_resumed(tmp_path):
    with pytest.raises(AssertionError):
        writer(tmp_path / "x.h5", resume=False, keep=0)
    assert os.listdir(tmp_path) == []


@pytest.mark.parametrize("resume", [True, False])
def test_closing_keeps_what_an_interruption_would(tmp_path, resume):
    opened = writer(tmp_path / "x.h5", resume=resume)
    opened.add_episode(**episode(0))
    opened.close()
    opened.close()
    assert os.listdir(tmp_path) == ([".x.h5.partial"] if resume else [])
    with pytest.raises(UserError, match="the writer is closed"):
        opened.add_episode(**episode(1))


def _opens(path, queue):
    try:
        writer(path).close()
        queue.put("opened")
    except UserError as error:
        queue.put(str(error))


def test_a_closed_recording_is_free_though_its_rows_are_still_mapped(tmp_path):
    """A mapping keeps the file open, and a lock lasts as long as that."""
    path = tmp_path / "x.h5"
    opened = writer(path)
    opened.add_episode(**episode(0))
    arrays, eye = opened.arrays(), episode(0)["observations"]["eye"]
    opened.close()
    context = multiprocessing.get_context("fork")
    queue = context.Queue()
    process = context.Process(target=_opens, args=(path, queue))
    process.start()
    assert queue.get(timeout=60) == "opened"
    process.join()
    with writer(path) as again:
        for number in range(1, len(LENGTHS)):
            again.add_episode(**episode(number))
    assert EpisodeStore(path).lengths.tolist() == list(LENGTHS)
    np.testing.assert_array_equal(arrays.gather("observations/eye", np.arange(LENGTHS[0])), eye)
