"""An unfinished recording goes on under the same options, and under no others."""

from __future__ import annotations

import errno
import multiprocessing
import os
import re

import h5py
import numpy as np
import pytest

from repdib_lightning.data.episodes import EpisodeStore
from repdib_lightning.data.inspection import inspect_store
from repdib_lightning.data.writer import EpisodeWriter
from repdib_lightning.errors import UserError
from repdib_lightning.records import ActionSpec, ArraySpec

LENGTHS = (4, 2, 5)


def writer(path, *, configuration=None, **changed):
    stated = {
        "rows": sum(LENGTHS),
        "episodes": len(LENGTHS),
        "observations": {"eye": ArraySpec((1, 2, 8))},
        "actions": ActionSpec("discrete", 3),
        "attributes": {"configuration": {"seed": 0, "view": {"size": 8}} | (configuration or {}), "seed": 0},
        "resume": True,
    }
    return EpisodeWriter(path, **stated | changed)


def add(opened, number):
    random = np.random.default_rng(number)
    length = LENGTHS[number]
    eye = random.integers(0, 256, (length, 1, 2, 8), dtype=np.uint8)
    opened.add_episode(observations={"eye": eye}, actions=random.integers(0, 3, length - 1), evaluation=number == 1)


def interrupted(path, *, episodes=2, error=KeyboardInterrupt, **options):
    with pytest.raises(error), writer(path, **options) as opened:
        for number in range(episodes):
            add(opened, number)
        raise error
    return path.with_name(f".{path.name}.partial")


def finish(path, **options):
    with writer(path, **options) as opened:
        found = opened.episodes_done
        for number in range(found, len(LENGTHS)):
            add(opened, number)
        assert opened.episodes_done == len(LENGTHS)
    return found


@pytest.fixture
def whole(tmp_path):
    (tmp_path / "other").mkdir()
    finish(tmp_path / "other" / "x.h5", resume=False)
    return (tmp_path / "other" / "x.h5").read_bytes()


@pytest.mark.parametrize("error", [KeyboardInterrupt, ZeroDivisionError, SystemExit])
@pytest.mark.parametrize("episodes", [0, 1, 2, 3])
def test_an_interruption_keeps_whole_episodes(tmp_path, whole, episodes, error):
    path = tmp_path / "x.h5"
    partial = interrupted(path, episodes=episodes, error=error)
    assert not path.exists() and partial.exists()
    assert finish(path) == episodes
    assert path.read_bytes() == whole and not partial.exists()
    assert EpisodeStore(path).evaluation.tolist() == [False, True, False]


def test_a_full_disk_in_the_middle_of_an_episode(tmp_path, whole, monkeypatch):
    path = tmp_path / "x.h5"
    real, room = os.pwrite, [150]

    def pwrite(handle, content, offset):
        if not room[0]:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        count = real(handle, content[: room[0]], offset)
        room[0] -= count
        return count

    with (
        monkeypatch.context() as full,
        pytest.raises(UserError, match=r"x\.h5: cannot be written \(No space left.*1 of 3 episodes are kept") as caught,
        writer(path) as opened,
    ):
        full.setattr(os, "pwrite", pwrite)
        for number in range(3):
            add(opened, number)
    assert "\n" not in str(caught.value)
    assert finish(path) == 1 and path.read_bytes() == whole


def test_a_disk_that_does_not_keep_the_rows_does_not_count_the_episode(tmp_path, whole, monkeypatch):
    path = tmp_path / "x.h5"

    def fdatasync(handle):
        raise OSError(errno.EIO, os.strerror(errno.EIO))

    with pytest.raises(UserError, match="Input/output error"), writer(path) as opened:
        add(opened, 0)
        monkeypatch.setattr(os, "fdatasync", fdatasync)
        add(opened, 1)
    monkeypatch.undo()
    assert finish(path) == 1 and path.read_bytes() == whole


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"configuration": {"seed": 1}}, "seed was 0, is 1;"),
        ({"configuration": {"view": {"size": 9}}}, r"view\.size was 8, is 9;"),
        ({"configuration": {"new": "x"}}, "new was absent, is x;"),
        ({"configuration": {"seed": 1, "view": {"size": 9}}}, r"seed was 0, is 1; view\.size was 8, is 9;"),
        ({"attributes": {"configuration": {"seed": 0, "view": {"size": 8}}, "seed": 3}}, "seed was absent, is 3;"),
        ({"rows": 12}, "rows was 11, is 12;"),
        ({"episodes": 4}, "episodes was 3, is 4;"),
        ({"rewards": True}, "rewards was absent"),
        ({"actions": ActionSpec("discrete", 4)}, "actions was .*size=3, is .*size=4;"),
        ({"observations": {"eye": ArraySpec((1, 2, 8), "float32")}}, "eye was 1x2x8 uint8, is 1x2x8 float32;"),
        (
            {"attributes": {"configuration": {"seed": 1, "view": {"size": 8}}, "seed": 1}, "rows": 99},
            "with other options: seed was 0, is 1; the same",
        ),
    ],
)
def test_other_options_are_named_and_nothing_is_lost(tmp_path, whole, changed, message):
    path = tmp_path / "x.h5"
    partial = interrupted(path)
    before = partial.read_bytes()
    with pytest.raises(UserError, match=rf"\.x\.h5\.partial: .*{message}.*--overwrite begins it anew") as caught:
        writer(path, **changed)
    assert "\n" not in str(caught.value) and partial.read_bytes() == before
    assert finish(path) == 2 and path.read_bytes() == whole


def _zero(file):
    file["episodes/length"][0] = 0


def _overlong(file):
    file["episodes/length"][1] = 99


def _no_arrays(file):
    del file["observations"], file["actions"]


@pytest.mark.parametrize("damage", [_zero, _overlong, _no_arrays, 0.5, b"not HDF5"])
def test_a_damaged_recording_is_one_line_and_begun_anew_if_wanted(tmp_path, whole, damage):
    path = tmp_path / "x.h5"
    partial = interrupted(path)
    if callable(damage):
        with h5py.File(partial, "r+") as file:
            damage(file)
    else:
        content = partial.read_bytes()
        partial.write_bytes(damage if isinstance(damage, bytes) else content[: int(len(content) * damage)])
    with pytest.raises(UserError, match=r"\.x\.h5\.partial: a damaged .*--overwrite begins it anew") as caught:
        writer(path)
    assert "\n" not in str(caught.value)
    assert finish(path, overwrite=True) == 0 and path.read_bytes() == whole
    assert not partial.exists()


def test_overwriting_begins_anew_with_other_options(tmp_path):
    path = tmp_path / "x.h5"
    interrupted(path)
    assert finish(path, overwrite=True, configuration={"seed": 1}) == 0
    assert '"seed": 1' in EpisodeStore(path).attributes["configuration"]


def test_an_overwritten_file_is_there_until_the_new_one_is(tmp_path, whole):
    path = tmp_path / "x.h5"
    finish(path)
    interrupted(path, overwrite=True, configuration={"seed": 1})
    assert path.read_bytes() == whole
    with pytest.raises(UserError, match="exists already"):
        writer(path)


def _open_in_child(path, queue):
    try:
        writer(path).__enter__()
        queue.put("opened")
    except UserError as error:
        queue.put(str(error))


@pytest.mark.parametrize("options", [{}, {"overwrite": True}])
def test_a_second_process_is_kept_out(tmp_path, whole, options):
    path = tmp_path / "x.h5"
    with writer(path) as first:
        add(first, 0)
        with pytest.raises(UserError, match=r"\.x\.h5\.partial: another process is writing") as caught:
            writer(path, **options)
        assert "\n" not in str(caught.value)
        context = multiprocessing.get_context("spawn")
        queue = context.Queue()
        process = context.Process(target=_open_in_child, args=(path, queue))
        process.start()
        assert "another process is writing" in queue.get(timeout=60)
        process.join()
        assert str(inspect_store(tmp_path / ".x.h5.partial")).count("\n") == 0
        add(first, 1)
        add(first, 2)
    assert path.read_bytes() == whole and os.listdir(tmp_path / "other") == ["x.h5"]
    assert sorted(os.listdir(tmp_path)) == ["other", "x.h5"]


def test_who_comes_when_the_file_has_just_appeared_leaves_it(tmp_path, whole, monkeypatch):
    path = tmp_path / "x.h5"
    real = os.statvfs

    def another_process_finishes(folder):
        monkeypatch.undo()
        finish(path)
        return real(folder)

    monkeypatch.setattr(os, "statvfs", another_process_finishes)
    with pytest.raises(UserError, match="exists already"):
        writer(path)
    assert sorted(os.listdir(tmp_path)) == ["other", "x.h5"] and path.read_bytes() == whole


@pytest.mark.parametrize("resume", [True, False])
@pytest.mark.parametrize("value", ["a\0b", 2**70])
def test_what_cannot_be_begun_leaves_nothing(tmp_path, value, resume):
    with pytest.raises(UserError, match="cannot be written"):
        writer(tmp_path / "x.h5", attributes={"odd": value}, resume=resume)
    assert os.listdir(tmp_path) == []


def test_leaving_early_keeps_the_episodes(tmp_path, whole):
    path = tmp_path / "x.h5"
    with (
        pytest.raises(UserError, match=r"not written.*2 of 3 episodes.*without"),
        writer(path, overwrite=True) as opened,
    ):
        add(opened, 0)
        add(opened, 1)
    assert finish(path) == 2 and path.read_bytes() == whole


def test_a_refused_episode_leaves_the_others(tmp_path, whole):
    path = tmp_path / "x.h5"
    with pytest.raises(UserError, match="episode 1: 'actions' is missing"), writer(path) as opened:
        add(opened, 0)
        opened.add_episode(observations={"eye": np.zeros((2, 1, 2, 8), np.uint8)})
    assert finish(path) == 1 and path.read_bytes() == whole


def test_inspect_says_what_it_is(tmp_path):
    partial = interrupted(tmp_path / "x.h5")
    text = str(inspect_store(partial))
    assert re.search(r"an unfinished recording of .*/x\.h5, 2 of 3 episodes", text) and "\n" not in text
    partial.write_bytes(partial.read_bytes()[:3000])
    with pytest.raises(UserError, match="a damaged unfinished recording"):
        inspect_store(partial)
