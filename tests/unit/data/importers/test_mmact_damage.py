"""MMAct with damaged files: what is skipped, in which words, and imports that are interrupted."""

from __future__ import annotations

import multiprocessing
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from mmact_tree import add_trial, convert, refuse, sensor_lines, write_sensor, write_tree, write_video

from repdib_lightning.data.importers import mmact as verb
from repdib_lightning.data.importers.mmact_notes import NoteLog, UnreadableFile
from repdib_lightning.data.importers.mmact_sensors import read_stream
from repdib_lightning.data.importers.mmact_workers import Workers
from repdib_lightning.errors import UserError

GYRO = "gyro_clip/subject1/scene1/session1/walking.csv"
VIDEO = "video/subject01/cam1/scene1/session1/walking.mp4"


@pytest.fixture
def source(tmp_path) -> Path:
    return write_tree(tmp_path / "MMAct")


def told(source: Path, capsys, **options) -> list[str]:
    """Lines of an import behind the first, which is checked to count them."""
    convert(source, **options)
    first, *others = capsys.readouterr().err.splitlines()
    assert "4 clips of 2 subjects" in first
    return others


LINE = sensor_lines(50)[0]
CASES: dict[str, tuple[Callable[[Path], object], str]] = {
    "empty": (lambda file: file.write_text(""), "is empty"),
    "blank": (lambda file: file.write_text("\n \n"), "is empty"),
    "header": (
        lambda file: write_sensor(file, ["timestamp,x,y,z", *sensor_lines(50)]),
        "line 1 is a header ('timestamp,x,y,z'), published files have none",
    ),
    "ragged": (
        lambda file: write_sensor(file, [*sensor_lines(50)[:3], LINE.rpartition(",")[0]]),
        "line 4: has 3 values, expected 4 (time, x, y, z)",
    ),
    "word": (
        lambda file: write_sensor(file, [LINE, LINE.replace("-9.8", "high")]),
        "line 2: 'high' is no finite number",
    ),
    "nan": (lambda file: write_sensor(file, [LINE, LINE.replace("-9.8", "nan")]), "line 2: 'nan' is no finite number"),
    "huge": (lambda file: write_sensor(file, [LINE.replace("-9.8", "1e39")]), "line 1: '1e39' is no finite number"),
    "stamp": (
        lambda file: write_sensor(file, [LINE, "17.5,1,2,3"]),
        "line 2: '17.5' is no time like 20190301_10:11:12.123456",
    ),
    "backwards": (
        lambda file: write_sensor(file, [*sensor_lines(50)[:4], *sensor_lines(50)[2:4]]),
        "line 5: goes back in time",
    ),
    "days": (
        lambda file: write_sensor(file, [LINE, LINE.replace("20190228", "20190301")]),
        "lasts 86,400 s by its stamps, more than 600 s",
    ),
    "bytes": (lambda file: file.write_bytes(b"\xff\xfe\x00"), "is no text file"),
}


@pytest.mark.parametrize("case", CASES)
def test_a_sensor_file_that_cannot_be_read_is_skipped_and_told(case, source, capsys):
    damage, why = CASES[case]
    damage(source / GYRO)
    with pytest.raises(UnreadableFile) as caught:
        read_stream(source / GYRO)
    assert str(caught.value) == why
    if case in ("empty", "header"):
        others = told(source, capsys)
        notes = source.parent / "out" / "store.h5.skipped.txt"
        assert others == [f"skipped {source}/{GYRO}: {why}", f"all of these lines are in {notes}"]
        assert notes.read_text() == f"{others[0]}\n"
        (source.parent / "out" / "store.h5").unlink()
        message = refuse(source, strict=True)
        assert message == f"{source}/{GYRO}: {why}; without --strict it is passed over and told at the end"


def test_readings_with_the_same_stamp_count_once(tmp_path):
    lines = sensor_lines(50)
    file = write_sensor(tmp_path / "x.csv", [lines[0], lines[1], lines[1].replace("-9.8", "5"), lines[2], ""])
    assert read_stream(file).values[:, 1].tolist() == [-9.8, -9.8, -9.8]


def test_a_stream_that_is_skipped_is_nan_and_counted(source, capsys):
    (source / GYRO).write_text("")
    store = convert(source)
    assert np.isnan(store.array("observations/gyroscope")).all(axis=(1, 2)).tolist() == [True, False, False, False]
    assert "; without gyroscope 1; files skipped 1" in capsys.readouterr().err


def test_a_video_that_cannot_be_read_is_skipped(source, capsys):
    (source / VIDEO).write_bytes(b"no video")
    other = source / VIDEO.replace("cam1", "cam3")
    other.write_bytes(other.read_bytes()[:300])
    others = told(source, capsys)
    assert others[0].startswith(f"skipped {source}/{VIDEO}: is no readable video (Invalid data")
    assert others[1].startswith(f"skipped {other}: is no readable video (")
    store = convert(source)
    assert not store.array("observations/cam1")[0].any() and store.array("observations/cam1")[1].any()
    store.path.unlink()
    assert f"{source}/{VIDEO}: is no readable video" in refuse(source, strict=True, overwrite=False)


def test_a_clip_shorter_than_a_segment_repeats_frames_and_is_told(source, capsys):
    write_video(source / VIDEO, frames=3)
    others = told(source, capsys, strict=True)
    assert others[0] == f"short {source}/{VIDEO}: 3 frames for 4 places, some are repeated"
    middle = convert(source).array("observations/cam1")[0, :, 1, 4, 4].astype(int)
    assert np.abs(middle - [20, 40, 40, 60]).max() <= 2


def test_what_comes_before_damage_in_the_middle_is_used(source, capsys):
    content = bytearray((source / VIDEO).read_bytes())
    start = content.index(b"mdat") + 4
    end = content.index(b"moov")
    content[start + (end - start) // 2 : end - 4] = b"\xff" * (end - 4 - start - (end - start) // 2)
    (source / VIDEO).write_bytes(content)
    others = told(source, capsys)
    assert others[0].startswith(f"broken {source}/{VIDEO}: breaks off after ") and "frames (Invalid data" in others[0]
    assert convert(source).array("observations/cam1")[0].any(axis=(1, 2, 3)).all()


def test_a_trial_of_which_nothing_can_be_read_is_left_out(source, capsys):
    for folder in ("acc_watch_clip", "acc_phone_clip", "gyro_clip", "orientation_clip"):
        (source / GYRO.replace("gyro_clip", folder)).write_text("")
        (source / GYRO.replace("gyro_clip", folder).replace("session1", "session5")).unlink()
    (source / VIDEO).write_bytes(b"")
    (source / VIDEO.replace("cam1", "cam3")).unlink()
    store = convert(source)
    assert store.rows == 3
    lines = capsys.readouterr().err.splitlines()
    assert lines[0].endswith(
        "; without acceleration of the watch 1, acceleration of the phone 1, gyroscope 1, "
        "orientation 1; files skipped 5; left out 1"
    )
    assert lines[6] == "left out subject 1, scene 1, session 1, walking: nothing of it can be read"
    assert store.array("observations/cam1")[0].any()
    store.path.unlink()
    for file in source.glob("*_clip/*/*/*/*.csv"):
        file.write_text("")
    assert f"{source}: not one sensor file is readable" in refuse(source)
    for file in source.glob("video/*/*/*/*/*.mp4"):
        file.write_bytes(b"")
    assert "nothing can be read: skipped" in refuse(source)


def test_what_is_not_of_the_layout_is_told(source, capsys):
    (source / "video/subjectA").mkdir()
    (source / "video/subject01/notes.txt").write_text("")
    (source / "video/subject01/.DS_Store").write_text("")
    (source / (VIDEO.replace("mp4", "avi"))).write_text("")
    others = told(source, capsys)
    assert others[:-1] == [
        f"skipped {source}/video/subject01/{VIDEO.partition('subject01/')[2].replace('mp4', 'avi')}: is no .mp4 file",
        f"skipped {source}/video/subject01/notes.txt: is no folder camN",
        f"skipped {source}/video/subjectA: is no folder subjectN",
    ]


def test_only_the_first_lines_are_printed_and_all_are_kept(source, capsys):
    for number in range(25):
        (source / f"video/subject01/odd{number:02d}").mkdir()
    others = told(source, capsys)
    notes = source.parent / "out" / "store.h5.skipped.txt"
    assert len(others) == 21 and others[-1] == f"... and 5 more; all of these lines are in {notes}"
    assert len(notes.read_text().splitlines()) == 25
    for number in range(25):
        (source / f"video/subject01/odd{number:02d}").rmdir()
    assert told(source, capsys) == [] and not notes.exists()


def test_several_processes_write_the_same_bytes(source, capsys):
    write_video(source / VIDEO, frames=3)
    (source / GYRO).write_text("")
    alone = convert(source).path.read_bytes(), capsys.readouterr().err
    together = convert(source, jobs=2).path.read_bytes(), capsys.readouterr().err
    assert alone == together
    assert multiprocessing.active_children() == []


def test_an_interrupted_import_goes_on_and_forgets_nothing(source, monkeypatch, capsys):
    for subject in (2, 3):
        add_trial(source, subject, 1, 1, "walking")
    write_video(source / VIDEO, frames=3)
    (source / VIDEO.replace("cam1", "cam3")).write_bytes(b"")
    write_video(source / "video/subject17/cam1/scene1/session1/walking.mp4", frames=2)
    whole = convert(source).path.read_bytes()
    notes, printed = source.parent / "out" / "store.h5.skipped.txt", capsys.readouterr().err
    text = notes.read_text()
    notes.unlink()
    (source.parent / "out" / "store.h5").unlink()
    read, seen = verb.read_clip, []

    def interrupted(clip, form):
        seen.append(str(clip))
        if len(seen) == 4:
            raise KeyboardInterrupt
        return read(clip, form)

    monkeypatch.setattr(verb, "read_clip", interrupted)
    with pytest.raises(KeyboardInterrupt):
        convert(source, overwrite=False)
    assert not (source.parent / "out" / "store.h5").exists()
    assert convert(source, overwrite=False).path.read_bytes() == whole
    assert len(seen) == 4 + 3 and seen[3] == seen[4]
    assert notes.read_text() == text and capsys.readouterr().err == printed
    assert sorted(file.name for file in notes.parent.iterdir()) == ["store.h5", "store.h5.skipped.txt"]


def test_notes_of_episodes_that_were_not_written_are_forgotten(tmp_path):
    log = NoteLog(tmp_path / "s.h5", 0)
    for episode in range(3):
        log.add(episode, [verb.Note("skipped", f"{episode}.mp4", "is empty")])
    with open(tmp_path / ".s.h5.notes", "a") as file:
        file.write('[3, "skip')
    again = NoteLog(tmp_path / "s.h5", 2)
    assert [note.what for note in again.notes] == ["0.mp4", "1.mp4"]
    again.add(2, [verb.Note("skipped", "x.mp4", "is empty")])
    assert [note.what for note in NoteLog(tmp_path / "s.h5", 9).notes] == ["0.mp4", "1.mp4", "x.mp4"]
    assert NoteLog(tmp_path / "s.h5", 0).notes == [] and not (tmp_path / ".s.h5.notes").exists()


def _fail(number: int) -> int:
    if number == 3:
        raise UserError("three")
    return -number


def test_results_come_in_order_and_errors_pass_through():
    with Workers(2) as workers:
        assert list(workers.map(abs, range(-20, 0))) == list(range(20, 0, -1))
        with pytest.raises(UserError, match="three"):
            list(workers.map(_fail, range(9)))
