"""The store: what is written is what is read, and nothing that is wrong gets past the reader."""

from __future__ import annotations

import os
import pickle

import h5py
import numpy as np
import pytest

from repdib_lightning.data.episodes import EpisodeStore
from repdib_lightning.data.files import whole_file
from repdib_lightning.data.schema import FactorSpec
from repdib_lightning.data.writer import EpisodeWriter
from repdib_lightning.errors import UserError
from repdib_lightning.records import ActionSpec, ArraySpec


def test_rows_come_back_in_any_order_and_with_repeats(store_file):
    store = EpisodeStore(store_file)
    rows = np.array([30, 2, 2, 44, 0])
    assert store.gather("observations/front", rows)[:, 0, 0, 0].tolist() == rows.tolist()
    with h5py.File(store_file) as file:
        np.testing.assert_array_equal(store.gather("observations/top", rows), file["observations/top"][:][rows])


def test_gathering_from_a_chunked_file_gives_the_same(store_file, tmp_path):
    chunked = tmp_path / "chunked.h5"
    with h5py.File(store_file) as old, h5py.File(chunked, "w") as new:
        for key in old:
            old.copy(key, new)
        new.attrs.update(old.attrs)
        frames = old["observations/front"][:]
        del new["observations/front"]
        new.create_dataset("observations/front", data=frames, chunks=(1, *frames.shape[1:]), compression="gzip")
    rows = np.array([7, 7, 31, 0])
    slow, fast = EpisodeStore(chunked), EpisodeStore(store_file)
    assert fast.contiguous and not slow.contiguous
    np.testing.assert_array_equal(slow.gather("observations/front", rows), fast.gather("observations/front", rows))


def test_factors_episodes_and_final_rows(store_file):
    store = EpisodeStore(store_file)
    assert store.factors["cell"] == FactorSpec("endogenous", "categorical", classes=4)
    assert store.episodes("train").tolist() == [0, 1] and store.episodes("evaluation").tolist() == [2, 3]
    assert store.actions_spec == ActionSpec("discrete", 4)
    last = store.starts + store.lengths - 1
    assert (store.gather("actions", last) == -1).all()


def test_masks_survive_packing(tmp_path):
    mask = np.random.default_rng(0).random((5, 7, 13)) < 0.5
    options = {"observations": {"eye": ArraySpec((1, 7, 13))}, "actions": None, "masks": {"eye": (7, 13)}}
    with EpisodeWriter(tmp_path / "m.h5", rows=5, episodes=1, **options) as writer:
        writer.add_episode(observations={"eye": np.zeros((5, 1, 7, 13), np.uint8)}, masks={"eye": mask})
    np.testing.assert_array_equal(EpisodeStore(tmp_path / "m.h5").mask("eye", np.arange(5)), mask)


def test_same_content_same_bytes(make_store, tmp_path):
    first, second = make_store(tmp_path / "a.h5"), make_store(tmp_path / "b.h5")
    assert first.read_bytes() == second.read_bytes()
    assert EpisodeStore(first).fingerprint != EpisodeStore(make_store(tmp_path / "c.h5", seed=1)).fingerprint


def test_pickles_as_its_path(store_file):
    store = EpisodeStore(store_file)
    store.gather("observations/front", np.arange(3))
    assert len(pickle.dumps(store)) < 10_000
    copy = pickle.loads(pickle.dumps(store))
    assert copy.gather("observations/front", np.array([9]))[0, 0, 0, 0] == 9


def test_an_error_while_writing_leaves_nothing(tmp_path):
    with (
        pytest.raises(ZeroDivisionError),
        EpisodeWriter(tmp_path / "x.h5", rows=4, episodes=1, observations={"eye": ArraySpec((1, 2, 2))}, actions=None),
    ):
        _ = 1 / 0
    assert os.listdir(tmp_path) == []


def test_an_existing_file_is_kept(store_file, make_store):
    before = store_file.read_bytes()
    with pytest.raises(UserError, match=r"small\.h5: exists already"):
        make_store(store_file)
    assert store_file.read_bytes() == before


def test_a_full_disk_is_one_line(tmp_path, monkeypatch):
    monkeypatch.setattr(os, "statvfs", lambda path: os.statvfs_result((1, 1, 1, 1, 1, 0, 0, 0, 0, 0)))
    with pytest.raises(UserError, match=r"cannot be written.*are free"):
        EpisodeWriter(tmp_path / "x.h5", rows=9, episodes=1, observations={"eye": ArraySpec((3, 9, 9))}, actions=None)
    assert os.listdir(tmp_path) == []


@pytest.mark.parametrize(
    ("key", "index", "value", "message"),
    [
        ("actions", 3, 9, r"'actions' is out of range at row 3 \(episode 0, step 3\): 9"),
        ("episodes/length", 1, 5, r"episode 2 starts at row 22 with length 11; row 18 was expected"),
        ("episodes/length", 3, 5, r"episodes cover 38 rows, the arrays hold 45"),
    ],
)
def test_wrong_values_name_key_and_episode(store_file, key, index, value, message):
    with h5py.File(store_file, "r+") as file:
        file[key][index] = value
    with pytest.raises(UserError, match=message):
        EpisodeStore(store_file)


def test_nan_in_continuous_actions(make_store, tmp_path):
    path = make_store(tmp_path / "c.h5", kind="continuous")
    with h5py.File(path, "r+") as file:
        file["actions"][14, 1] = np.nan
    with pytest.raises(UserError, match=r"'actions' is not finite.*row 14 \(episode 1, step 1\)"):
        EpisodeStore(path)


def test_lengths_that_disagree(store_file):
    with h5py.File(store_file, "r+") as file:
        del file["actions"]
        file["actions"] = np.zeros(44, np.int64)
    with pytest.raises(UserError, match=r"'actions' has 44 rows, 'observations/front' has 45"):
        EpisodeStore(store_file)


def test_newer_schema(store_file):
    with h5py.File(store_file, "r+") as file:
        file.attrs["schema_version"] = 99
    with pytest.raises(UserError, match="schema version 99 is newer"):
        EpisodeStore(store_file)


@pytest.mark.parametrize("content", [b"", b"not HDF5 at all", None])
def test_files_that_are_no_stores(store_file, content):
    whole = store_file.read_bytes()
    store_file.write_bytes(whole[: len(whole) // 2] if content is None else content)
    with pytest.raises(UserError, match=r"truncated|not a readable HDF5 file"):
        EpisodeStore(store_file)


def test_a_missing_file_names_the_nearest(store_file):
    with pytest.raises(UserError, match=r"no such data file, did you mean 'small\.h5'"):
        EpisodeStore(store_file.with_name("smal.h5"))


def test_foreign_hdf5(tmp_path):
    with h5py.File(tmp_path / "f.h5", "w") as file:
        file["image"] = np.zeros(3)
    with pytest.raises(UserError, match=r"not a store of this package.*image.*import"):
        EpisodeStore(tmp_path / "f.h5")


def test_whole_file_is_whole_or_absent(tmp_path):
    target = tmp_path / "t.json"
    target.write_text("old")
    with pytest.raises(RuntimeError), whole_file(target) as path:
        path.write_text("half")
        raise RuntimeError
    assert target.read_text() == "old" and os.listdir(tmp_path) == ["t.json"]
    with whole_file(target) as path:
        path.write_text("new")
    assert target.read_text() == "new" and os.listdir(tmp_path) == ["t.json"]


def test_writing_below_a_file_is_one_line(tmp_path):
    (tmp_path / "file").touch()
    with pytest.raises(UserError, match="cannot be written"), whole_file(tmp_path / "file" / "x.json") as path:
        path.write_text("")
