"""A recording that is killed, at any moment, goes on, and becomes the file that it would have become."""

from __future__ import annotations

import os
import random
import signal

import h5py
import pytest
from recording_child import LENGTHS, in_child, record, writer

from repdib_lightning.data.episodes import EpisodeStore
from repdib_lightning.data.fingerprint import recompute_fingerprint


def test_a_kill_at_any_write_costs_no_whole_episode(tmp_path):
    expected, path = tmp_path / "whole.h5", tmp_path / "x.h5"
    record(expected, resume=False)
    partial = tmp_path / ".x.h5.partial"
    found = []
    for step in range(200):
        code = in_child(path, die_at=step)
        if code == 0:
            break
        assert code == -signal.SIGKILL
        if partial.exists() and partial.stat().st_size:
            with h5py.File(partial) as file:
                assert len(file["observations/eye"]) == sum(LENGTHS)
        if not path.exists():
            found.append(record(path))
        assert path.read_bytes() == expected.read_bytes(), step
        assert sorted(os.listdir(tmp_path)) == ["whole.h5", "x.h5"]
        path.unlink()
    assert code == 0 and step > 30
    assert found == sorted(found) and set(found) == set(range(len(LENGTHS) + 1))


def test_kills_at_random_moments_one_after_the_other(tmp_path):
    repeats, moments = 200, random.Random(0)
    expected, path = tmp_path / "whole.h5", tmp_path / "x.h5"
    record(expected, repeats=repeats, resume=False)
    codes, done = [], [0]
    while len(codes) < 8 and 0 not in codes:
        codes.append(in_child(path, repeats=repeats, kill_after=moments.uniform(0, 0.06)))
        if codes[-1] != 0:
            with pytest.raises(KeyboardInterrupt), writer(path, repeats=repeats) as opened:
                done.append(opened.episodes_done)
                raise KeyboardInterrupt
    assert codes.count(-signal.SIGKILL) >= 2 and done == sorted(done) and len(set(done)) > 2
    if not path.exists():
        record(path, repeats=repeats)
    assert path.read_bytes() == expected.read_bytes()
    store = EpisodeStore(path)
    assert recompute_fingerprint(store) == store.fingerprint
