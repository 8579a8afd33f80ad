"""Stores that another program wrote: they work, or one line names file and key."""

from __future__ import annotations

import h5py
import numpy as np
import pytest

from repdib_lightning.data.datamodule import EpisodeDataModule
from repdib_lightning.data.episodes import EpisodeStore
from repdib_lightning.data.sampling import FutureSampling
from repdib_lightning.errors import UserError


def replace(path, key, values, **attributes):
    with h5py.File(path, "r+") as file:
        kept = dict(file[key].attrs) if key in file else {}
        if key in file:
            del file[key]
        if values is not None:
            file[key] = values
            file[key].attrs.update(kept | attributes)


@pytest.mark.parametrize("dtype", ["<i4", ">i4", ">i8", "u1"])
def test_discrete_actions_of_any_integer_type(store_file, dtype):
    before = EpisodeStore(store_file).gather("actions", np.arange(12))
    replace(store_file, "actions", np.maximum(EpisodeStore(store_file).array("actions")[:], 0).astype(dtype))
    after = EpisodeStore(store_file).gather("actions", np.arange(12))
    assert after.dtype == np.dtype("int64") and after.dtype.isnative
    np.testing.assert_array_equal(before, after)


def test_byte_strings_are_decoded(store_file):
    with h5py.File(store_file, "r+") as file:
        file.attrs["format"] = np.bytes_("repdib_episodes")
        file["actions"].attrs["kind"] = np.bytes_("discrete")
        file["factors/cell"].attrs["kind"] = np.bytes_("endogenous")
    assert EpisodeStore(store_file).factors["cell"].kind == "endogenous"


@pytest.mark.parametrize(
    ("key", "values", "attributes", "message"),
    [
        ("actions", np.zeros((45, 1), int), {}, r"discrete 'actions' must be \(N,\) integers"),
        ("actions", np.zeros(45, int), {"kind": "foo"}, "kind of 'actions' is 'foo'"),
        ("extra", np.float64(3), {}, "'extra' is a scalar"),
        ("observations", np.zeros(45), {}, "'observations' must be a group"),
        ("observations/group/x", np.zeros(45), {}, "'observations/group' must be a data set, is a group"),
        ("masks/front", np.zeros((45, 24, 3), np.uint8), {}, "'masks/front' needs an attribute width"),
        ("factors/cell", np.array([b"a"] * 45), {}, "'factors/cell' must be numbers"),
        ("factors/light", np.zeros((45, 2, 2)), {}, "'factors/light' must be numbers of shape"),
        ("factors/cell", np.full(45, 4), {}, "'factors/cell' holds class 4"),
        ("observations/x", np.zeros(45, np.float32), {}, r"'observations/x' has shape \(45,\)"),
        ("observations/x", np.float32(1), {}, "'observations/x' is a scalar"),
        ("observations/x", np.zeros((45, 2), ">f4"), {}, "'observations/x' is .*big-endian.*must be uint8 or float32"),
        ("observations/x", np.zeros((45, 2)), {}, "'observations/x' is float64, must be uint8 or float32"),
        ("episodes/start", np.zeros(4), {}, r"'episodes/start' must be \(E,\) integers"),
    ],
)
def test_one_line_names_file_and_key(store_file, key, values, attributes, message):
    replace(store_file, key, values, **attributes)
    with pytest.raises(UserError, match=rf"small\.h5: .*{message}") as caught:
        EpisodeStore(store_file)
    assert "\n" not in str(caught.value)


def test_a_missing_schema_version(store_file):
    with h5py.File(store_file, "r+") as file:
        del file.attrs["schema_version"]
    with pytest.raises(UserError, match="schema_version is missing; set it to 1"):
        EpisodeStore(store_file)


def test_episodes_without_a_step_and_without_evaluation(make_store, tmp_path):
    store = EpisodeStore(make_store(tmp_path / "a.h5", lengths=(5, 1, 4), evaluation=(2,)))
    with pytest.raises(UserError, match=r"episode 1 has one row and therefore no step.*leave this episode out"):
        FutureSampling(store, "train", horizon=5, futures=1, seed=0)
    store = EpisodeStore(make_store(tmp_path / "b.h5", lengths=(9,), evaluation=()))
    with pytest.raises(UserError, match=r"mark some in `episodes/evaluation`, or have at least 5 episodes"):
        FutureSampling(store, "evaluation", horizon=1, futures=1, seed=0)


def test_no_views_is_not_all_views(store_file):
    with pytest.raises(UserError, match=r"data\.views is empty"):
        EpisodeDataModule(str(store_file), views=[])
