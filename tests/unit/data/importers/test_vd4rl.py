"""V-D4RL: every value arrives, actions are moved to where they were taken, and nothing is skipped in silence."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from vd4rl_files import Episode, as_npz, concatenate, record, split, write_npz, write_shard

from repdib_lightning.data.episodes import EpisodeStore
from repdib_lightning.data.fingerprint import recompute_fingerprint
from repdib_lightning.data.importers.vd4rl import import_vd4rl
from repdib_lightning.errors import UserError


def check_values(store: EpisodeStore, episodes: list[Episode]) -> None:
    assert store.lengths.tolist() == [len(episode["action"]) for episode in episodes]
    for index, episode in enumerate(episodes):
        start, length = store.starts[index], store.lengths[index]
        rows = slice(start, start + length)
        np.testing.assert_array_equal(store.array("observations/pixels")[rows], episode["observation"])
        for t in range(length - 1):
            np.testing.assert_array_equal(store.array("actions")[start + t], episode["action"][t + 1])
            assert store.array("rewards")[start + t] == episode["reward"][t + 1]
        assert not store.array("actions")[start + length - 1].any()
        assert store.array("rewards")[start + length - 1] == 0
    assert recompute_fingerprint(store) == store.fingerprint


def refuse(source: Path, output: Path, *words: str) -> None:
    """One line that holds every word, and no file left in the output's folder."""
    with pytest.raises(UserError) as caught:
        import_vd4rl(source, output, progress=False)
    message = str(caught.value)
    assert "\n" not in message
    for word in words:
        assert word in message, message
    assert not output.parent.exists() or not list(output.parent.iterdir())


@pytest.fixture
def output(tmp_path: Path) -> Path:
    return tmp_path / "out" / "store.h5"


def test_npz_episodes_of_different_lengths_round_trip(tmp_path: Path, output: Path) -> None:
    folder = tmp_path / "vd4rl_data" / "main" / "walker_walk" / "expert" / "64px"
    episodes = [record(index, rows, size=64) for index, rows in enumerate((11, 7, 11))]
    for index, episode in enumerate(episodes):
        write_npz(folder, index, as_npz(episode))
    assert import_vd4rl(folder, output, progress=False) == output
    store = EpisodeStore(output)
    check_values(store, episodes)
    assert store.attributes["environment"] == "dm_control/walker_walk"
    assert store.attributes["policy"] == "expert"
    assert store.array("truncations")[:].sum() == 3
    assert store.array("truncations")[store.starts + store.lengths - 2].all()
    assert not store.array("terminations")[:].any()


def test_hdf5_shards_are_read_in_numeric_order(tmp_path: Path, output: Path) -> None:
    episodes = [record(index, 4) for index in range(12)]
    for index, episode in enumerate(episodes):
        write_shard(tmp_path / "84px" / f"{index}.hdf5", episode)
    check_values(EpisodeStore(import_vd4rl(tmp_path / "84px", output, progress=False)), episodes)


@pytest.mark.parametrize("cuts", [[11], [5], [12], [22, 25], [3, 5, 30], [10], [32]])
def test_shards_cut_anywhere_are_joined(tmp_path: Path, output: Path, cuts: list[int]) -> None:
    episodes = [record(index) for index in range(3)]
    for index, keys in enumerate(split(concatenate(episodes), cuts)):
        write_shard(tmp_path / "84px" / f"{index}.hdf5", keys)
    check_values(EpisodeStore(import_vd4rl(tmp_path / "84px", output, progress=False)), episodes)


def test_one_file_can_be_imported(tmp_path: Path, output: Path) -> None:
    episodes = [record(0), record(1, 6)]
    shard = write_shard(tmp_path / "data.hdf5", concatenate(episodes))
    check_values(EpisodeStore(import_vd4rl(shard, output, progress=False)), episodes)


@pytest.mark.parametrize("form", ["npz", "hdf5"])
def test_a_last_discount_of_zero_is_a_termination(tmp_path: Path, output: Path, form: str) -> None:
    episode = record(0, size=64 if form == "npz" else 84)
    episode["discount"][-1] = 0
    source = write_npz(tmp_path, 0, as_npz(episode)) if form == "npz" else write_shard(tmp_path / "0.hdf5", episode)
    store = EpisodeStore(import_vd4rl(source, output, progress=False))
    assert np.flatnonzero(store.array("terminations")).tolist() == [9]
    assert not np.any(store.array("truncations"))


def test_is_terminal_is_a_termination(tmp_path: Path, output: Path) -> None:
    keys = as_npz(record(0, size=64))
    keys["is_terminal"][-1] = True
    store = EpisodeStore(import_vd4rl(write_npz(tmp_path, 0, keys), output, progress=False))
    assert np.flatnonzero(store.array("terminations")).tolist() == [9]


def test_first_shard_that_starts_mid_episode(tmp_path: Path, output: Path) -> None:
    _, rest = split(concatenate([record(0), record(1)]), [4])
    write_shard(tmp_path / "84px" / "3.hdf5", rest)
    refuse(tmp_path / "84px", output, "3.hdf5", "row 0", "middle of an episode")


def test_a_missing_shard_between_two_halves_is_not_joined(tmp_path: Path, output: Path) -> None:
    pieces = split(concatenate([record(0), record(1)]), [4, 15])
    write_shard(tmp_path / "84px" / "0.hdf5", pieces[0])
    write_shard(tmp_path / "84px" / "2.hdf5", pieces[2])
    refuse(tmp_path / "84px", output, "2.hdf5", "row 0", "0.hdf5")


def test_a_shard_that_is_cut_before_a_new_episode(tmp_path: Path, output: Path) -> None:
    write_shard(tmp_path / "84px" / "0.hdf5", split(record(0), [4])[0])
    write_shard(tmp_path / "84px" / "1.hdf5", record(1))
    refuse(tmp_path / "84px", output, "0.hdf5", "row 3", "1.hdf5")


def test_a_last_shard_that_is_cut(tmp_path: Path, output: Path) -> None:
    write_shard(tmp_path / "84px" / "0.hdf5", split(concatenate([record(0), record(1)]), [15])[0])
    refuse(tmp_path / "84px", output, "0.hdf5", "row 14", "last shard")


def test_an_episode_that_starts_before_the_last_one_ended(tmp_path: Path, output: Path) -> None:
    keys = concatenate([record(0), record(1)])
    keys["step_type"][10] = 1
    write_shard(tmp_path / "84px" / "0.hdf5", keys)
    refuse(tmp_path / "84px", output, "0.hdf5", "row 11")


@pytest.mark.parametrize("key", ["image", "action", "reward", "discount"])
def test_npz_missing_key(tmp_path: Path, output: Path, key: str) -> None:
    write_npz(tmp_path / "64px", 0, as_npz(record(0, size=64)))
    keys = as_npz(record(1, size=64))
    del keys[key]
    np.savez_compressed(tmp_path / "64px" / "b.npz", **keys)
    refuse(tmp_path / "64px", output, "b.npz", f"'{key}'", "missing")


@pytest.mark.parametrize("key", ["observation", "action", "reward", "discount", "step_type"])
def test_hdf5_missing_key(tmp_path: Path, output: Path, key: str) -> None:
    keys = record(0)
    del keys[key]
    write_shard(tmp_path / "84px" / "0.hdf5", keys)
    refuse(tmp_path / "84px", output, "0.hdf5", f"'{key}'", "missing")


@pytest.mark.parametrize("form", ["npz", "hdf5"])
@pytest.mark.parametrize("key", ["action", "reward", "discount"])
def test_lengths_that_disagree(tmp_path: Path, output: Path, form: str, key: str) -> None:
    keys = as_npz(record(0, size=64)) if form == "npz" else record(0)
    keys[key] = keys[key][:-2]
    if form == "npz":
        write_npz(tmp_path / "in", 0, keys, length=11)
    else:
        write_shard(tmp_path / "in" / "0.hdf5", keys)
    refuse(tmp_path / "in", output, form, f"'{key}'", "9", "11")


def test_npz_file_name_that_disagrees(tmp_path: Path, output: Path) -> None:
    write_npz(tmp_path / "64px", 0, as_npz(record(0, size=64)), length=501)
    refuse(tmp_path / "64px", output, "501", "11 rows")


@pytest.mark.parametrize("form", ["npz", "hdf5"])
def test_pictures_of_a_wrong_type(tmp_path: Path, output: Path, form: str) -> None:
    keys = as_npz(record(0, size=64)) if form == "npz" else record(0)
    name = "image" if form == "npz" else "observation"
    keys[name] = (keys[name] / 255).astype(np.float32)
    if form == "npz":
        write_npz(tmp_path / "in", 0, keys)
    else:
        write_shard(tmp_path / "in" / "0.hdf5", keys)
    refuse(tmp_path / "in", output, f"'{name}'", "float32", "uint8")


def test_stacked_frames_are_refused(tmp_path: Path, output: Path) -> None:
    keys = record(0)
    keys["observation"] = np.repeat(keys["observation"], 3, axis=1)
    write_shard(tmp_path / "84px" / "0.hdf5", keys)
    refuse(tmp_path / "84px", output, "'observation'", "9", "un-stacked")


def test_text_actions_are_refused(tmp_path: Path, output: Path) -> None:
    keys = as_npz(record(0, size=64))
    keys["action"] = np.array(["left"] * 11)
    write_npz(tmp_path / "64px", 0, keys)
    refuse(tmp_path / "64px", output, "'action'", "floating point")


def test_shards_that_differ_in_size(tmp_path: Path, output: Path) -> None:
    write_shard(tmp_path / "in" / "0.hdf5", record(0))
    write_shard(tmp_path / "in" / "1.hdf5", record(1, size=64))
    refuse(tmp_path / "in", output, "1.hdf5", "64", "84")


@pytest.mark.parametrize("form", ["npz", "hdf5"])
def test_nan_action_names_its_row(tmp_path: Path, output: Path, form: str) -> None:
    first, second = record(0), record(1)
    second["action"][4, 2] = np.nan
    if form == "npz":
        write_npz(tmp_path / "in", 0, as_npz(first))
        write_npz(tmp_path / "in", 1, as_npz(second))
        refuse(tmp_path / "in", output, "-11.npz", "'action'", "row 4")
    else:
        write_shard(tmp_path / "in" / "0.hdf5", concatenate([first, second]))
        refuse(tmp_path / "in", output, "0.hdf5", "'action'", "row 15")


def test_nan_at_the_first_row_of_a_continued_episode_is_found(tmp_path: Path, output: Path) -> None:
    episode = record(0)
    episode["action"][5] = np.nan
    for index, keys in enumerate(split(episode, [5])):
        write_shard(tmp_path / "in" / f"{index}.hdf5", keys)
    refuse(tmp_path / "in", output, "1.hdf5", "'action'", "row 0")


def test_nan_in_the_placeholder_row_is_harmless(tmp_path: Path, output: Path) -> None:
    episode = record(0)
    episode["action"][0] = np.nan
    shard = write_shard(tmp_path / "0.hdf5", episode)
    check_values(EpisodeStore(import_vd4rl(shard, output, progress=False)), [episode])


@pytest.mark.parametrize("cuts", [[], [4]])
def test_termination_before_the_end(tmp_path: Path, output: Path, cuts: list[int]) -> None:
    episode = record(0)
    episode["discount"][3] = 0
    for index, keys in enumerate(split(episode, cuts)):
        write_shard(tmp_path / "in" / f"{index}.hdf5", keys)
    refuse(tmp_path / "in", output, "0.hdf5", "'discount'", "row 3")


def test_truncated_npz(tmp_path: Path, output: Path) -> None:
    path = write_npz(tmp_path / "64px", 0, as_npz(record(0, size=64)))
    path.write_bytes(path.read_bytes()[:-200])
    refuse(tmp_path / "64px", output, path.name, "not a readable npz file")


def test_npz_with_damaged_pictures_leaves_no_output(tmp_path: Path, output: Path) -> None:
    write_npz(tmp_path / "64px", 0, as_npz(record(0, size=64)))
    path = write_npz(tmp_path / "64px", 1, as_npz(record(1, size=64)))
    content = bytearray(path.read_bytes())
    content[40_000:40_100] = bytes(100)
    path.write_bytes(content)
    refuse(tmp_path / "64px", output, path.name, "'image'", "cannot be read")


def test_truncated_shard(tmp_path: Path, output: Path) -> None:
    path = write_shard(tmp_path / "84px" / "0.hdf5", record(0))
    path.write_bytes(path.read_bytes()[:-20_000])
    refuse(tmp_path / "84px", output, "0.hdf5", "truncated")


def test_shard_that_is_no_hdf5(tmp_path: Path, output: Path) -> None:
    (tmp_path / "84px").mkdir()
    (tmp_path / "84px" / "0.hdf5").write_text("<html>quota exceeded</html>")
    refuse(tmp_path / "84px", output, "0.hdf5", "not a readable HDF5 file")


def test_nothing_to_import(tmp_path: Path, output: Path) -> None:
    (tmp_path / "empty").mkdir()
    refuse(tmp_path / "empty", output, "empty", "no V-D4RL files")
    refuse(tmp_path / "absent", output, "absent", "no such file or folder")


def test_folder_above_the_data_names_the_right_one(tmp_path: Path, output: Path) -> None:
    write_shard(tmp_path / "expert" / "84px" / "0.hdf5", record(0))
    refuse(tmp_path / "expert", output, "did you mean", "84px")


def test_both_forms_in_one_folder(tmp_path: Path, output: Path) -> None:
    write_shard(tmp_path / "in" / "0.hdf5", record(0))
    write_npz(tmp_path / "in", 0, as_npz(record(0, size=64)))
    refuse(tmp_path / "in", output, "both")


def test_existing_output_is_kept_unless_overwritten(tmp_path: Path, output: Path) -> None:
    shard = write_shard(tmp_path / "0.hdf5", record(0))
    output.parent.mkdir()
    output.write_text("mine")
    with pytest.raises(UserError, match="exists already"):
        import_vd4rl(shard, output, progress=False)
    assert output.read_text() == "mine"
    import_vd4rl(shard, output, overwrite=True, progress=False)
    assert EpisodeStore(output).rows == 11


def test_shard_with_a_damaged_chunk_leaves_no_output(tmp_path: Path, output: Path) -> None:
    path = write_shard(tmp_path / "84px" / "0.hdf5", record(0))
    content = bytearray(path.read_bytes())
    middle = len(content) // 2
    content[middle : middle + 2000] = bytes(2000)
    path.write_bytes(content)
    refuse(tmp_path / "84px", output, "0.hdf5", "'observation'", "cannot be read")


def test_a_store_of_our_own_is_named_as_such(tmp_path: Path, output: Path) -> None:
    store = import_vd4rl(write_shard(tmp_path / "0.hdf5", record(0)), tmp_path / "store.h5", progress=False)
    refuse(store, output, "store.h5", "already")
