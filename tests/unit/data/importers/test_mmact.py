"""MMAct's folders: what becomes a clip, of which arrays and factors, and how splits hold clips out."""

from __future__ import annotations

import json
from pathlib import Path

import h5py
import numpy as np
import pytest
from mmact_tree import FRAMES, STEP, add_trial, convert, refuse, sensor_lines, write_sensor, write_tree, write_video

from repdib_lightning.__main__ import main
from repdib_lightning.data.episodes import EpisodeStore
from repdib_lightning.data.importers.mmact_activities import CLASSES
from repdib_lightning.data.importers.mmact_sensors import read_stream, resample
from repdib_lightning.data.importers.mmact_videos import places, read_film
from repdib_lightning.word_lists import in_ranges


@pytest.fixture
def source(tmp_path) -> Path:
    return write_tree(tmp_path / "MMAct")


def names(store: EpisodeStore, factor: str) -> list[str]:
    classes = json.loads(store.attributes["classes"])[factor]
    return [classes[value] for value in store.array(f"factors/{factor}")]


def brightness(store: EpisodeStore, view: str, row: int = 0) -> list[int]:
    """Of the middle of each frame."""
    return store.array(f"observations/{view}")[row, :, 1, 4, 4].tolist()


def test_a_trial_is_an_episode_with_its_videos_sensors_and_factors(source):
    store = convert(source)
    assert store.lengths.tolist() == [1] * 4 and store.actions_spec is None
    shapes = {name: spec.shape for name, spec in store.observations.items()}
    assert shapes == {
        "cam1": (4, 3, 8, 8),
        "cam3": (4, 3, 8, 8),
        "acceleration": (8, 6),
        "gyroscope": (8, 3),
        "orientation": (8, 3),
    }
    kinds = {name: (factor.kind, factor.classes) for name, factor in store.factors.items()}
    exogenous = {name: ("exogenous", count) for name, count in {"subject": 2, "scene": 1, "session": 2}.items()}
    assert kinds == {"activity": ("endogenous", 37), **exogenous}
    assert names(store, "subject") == ["1", "1", "17", "17"] and names(store, "session") == ["1", "5", "1", "5"]
    assert set(names(store, "activity")) == {"walking"}
    assert json.loads(store.attributes["rate"]) == dict.fromkeys(("acceleration", "gyroscope", "orientation"), 25)
    channels = json.loads(store.attributes["channels"])
    assert channels["acceleration"][2:4] == ["watch z", "phone x"] and channels["orientation"][0] == "phone azimuth"


def test_the_frames_are_in_the_middle_of_even_parts_of_what_was_decoded(source, tmp_path):
    assert places(FRAMES, 4) == [1, 3, 6, 8]
    slow = [int((part + 0.5) / 16 * 93) for part in range(16)]
    assert places(93, 16) == slow
    store = convert(source)
    for view, camera in (("cam1", 1), ("cam3", 3)):
        expected = [STEP + camera + STEP * place for place in (1, 3, 6, 8)]
        assert np.abs(np.array(brightness(store, view)) - expected).max() <= 2
    tall = read_film(write_video(tmp_path / "tall.mp4", frames=3, width=16, height=40), 8, 3)
    assert tall.frames.shape == (3, 3, 8, 8) and (tall.decoded, tall.broken) == (3, "")


def test_the_short_side_is_resized_and_the_middle_square_kept(tmp_path):
    film = read_film(write_video(tmp_path / "wide.mp4", frames=1, width=32, height=16), 8, 1)
    assert np.abs(film.frames.astype(int) - STEP).max() <= 2  # the white outer quarters are cut off
    wider = read_film(write_video(tmp_path / "wider.mp4", frames=1, width=24, height=16), 8, 1)
    assert (wider.frames[0, :, :, [0, -1]] > 100).all() and np.abs(
        wider.frames[0, :, :, 3:5].astype(int) - STEP
    ).max() < 9


def test_a_black_frame_is_not_a_missing_one(tmp_path):
    film = read_film(write_video(tmp_path / "black.mp4", frames=1, width=32, height=16, first=0), 8, 2)
    assert film.frames.any(axis=(1, 2, 3)).all() and film.frames.sum() == 2


def test_readings_are_linear_on_their_own_clock_across_midnight(source):
    store = convert(source)
    times = np.arange(8) / 25
    for row, subject in ((0, 1), (3, 17)):
        for part in (store.array("observations/acceleration")[row, :, 3:], store.array("observations/gyroscope")[row]):
            expected = np.stack([times + subject, np.full(8, -9.8), 2 * (times + subject)], axis=1)
            np.testing.assert_allclose(part, expected, rtol=1e-5)


def test_resampling_agrees_with_a_slow_version_on_uneven_steps(tmp_path):
    generator = np.random.default_rng(0)
    seconds = np.concatenate([[0], np.cumsum(generator.uniform(0.002, 0.03, 60))])
    values = generator.normal(size=(61, 3))
    stamps = [f"20190301_10:00:{second + 1:09.6f}" for second in seconds]
    file = write_sensor(
        tmp_path / "x.csv", [f"{stamp},{x},{y},{z}" for stamp, (x, y, z) in zip(stamps, values, strict=True)]
    )
    sampled = resample(read_stream(file), 25, 40)
    for step in range(40):
        time = step / 25
        if time > seconds[-1]:
            assert np.isnan(sampled[step]).all()
            continue
        after = int(np.searchsorted(seconds, time))
        before = max(after - 1, 0)
        share = 0 if after == before else (time - seconds[before]) / (seconds[after] - seconds[before])
        np.testing.assert_allclose(sampled[step], values[before] + share * (values[after] - values[before]), atol=1e-3)
    assert np.isnan(sampled).any() and np.isfinite(sampled).any()


def test_angles_go_the_shorter_way_round(source):
    lines = [
        f"20190301_10:00:00.{20 * step:03d},{(351.3 + step) % 360},0,{-178.5 - step + 360 * (step > 1)}"
        for step in range(16)
    ]
    write_sensor(source / "orientation_clip/subject1/scene1/session1/walking.csv", lines)
    azimuth = convert(source, rate=30).array("observations/orientation")[0, :10, 0]
    turned = 351.3 + np.arange(10) / 30 * 50
    np.testing.assert_allclose((azimuth - turned + 180) % 360 - 180, 0, atol=1e-3)
    assert azimuth.min() > -0.6 and azimuth.max() < 360.6
    roll = convert(source, rate=30).array("observations/orientation")[0, :10, 2]
    np.testing.assert_allclose((roll + 178.5 + np.arange(10) / 30 * 50 + 180) % 360 - 180, 0, atol=1e-3)
    assert np.abs(roll).max() < 180.6


def test_shorter_streams_end_in_nan_and_the_length_can_be_set(source):
    write_sensor(source / "gyro_clip/subject1/scene1/session1/walking.csv", sensor_lines(50, seconds=0.1))
    gyroscope = convert(source).array("observations/gyroscope")
    assert np.isfinite(gyroscope[0]).all(axis=1).tolist() == [True] * 3 + [False] * 5
    assert np.isfinite(gyroscope[1:]).all()
    assert convert(source, seconds=0.16).observations["gyroscope"].shape == (4, 3)
    longer = convert(source, seconds=1, rate=10).array("observations/acceleration")
    assert np.isfinite(longer).all(axis=2).tolist() == [[True] * 4 + [False] * 6] * 4


def test_what_is_missing_is_masked_and_counted_not_dropped(source, capsys):
    (source / "video/subject01/cam3/scene1/session1/walking.mp4").unlink()
    (source / "acc_phone_clip/subject1/scene1/session1/walking.csv").unlink()
    (source / "gyro_clip/subject17/scene1/session5/walking.csv").unlink()
    (source / "gyro_clip/subject1/scene1/session5/walking.csv").unlink()
    store = convert(source)
    assert store.rows == 4
    assert [bool(frames.any()) for frames in store.array("observations/cam3")] == [False, True, True, True]
    acceleration = store.array("observations/acceleration")
    assert np.isfinite(acceleration[0, :, :3]).all() and np.isnan(acceleration[0, :, 3:]).all()
    assert np.isnan(store.array("observations/gyroscope")).all(axis=(1, 2)).tolist() == [False, True, False, True]
    lines = capsys.readouterr().err.splitlines()
    assert lines == [
        f"{store.path}: 4 clips of 2 subjects; 2 to train on, 2 to test on (subject 17-20); "
        "without cam3 1, acceleration of the phone 1, gyroscope 2"
    ]
    assert not Path(f"{store.path}.skipped.txt").exists()


def test_names_are_lower_case_and_the_desk_scene_has_classes_of_its_own(source):
    add_trial(source, 2, 1, 1, "Carrying_light")
    for scene in (1, 3):
        for activity in ("using_phone", "talking_on_phone", "using_pc"):
            add_trial(source, 3, scene, 1, activity, cameras=())
    store = convert(source)
    chosen = [name for name, who in zip(names(store, "activity"), names(store, "subject"), strict=True) if who == "3"]
    assert chosen[:3] == ["talking_on_phone", "using_pc", "using_phone"]
    assert chosen[3:] == ["talking_on_phone_desk", "using_pc", "using_phone_desk"]
    assert "carrying_light" in names(store, "activity")
    assert json.loads(store.attributes["classes"])["activity"] == CLASSES
    assert len(CLASSES) == len(set(CLASSES)) == 37 and sorted(CLASSES) == CLASSES


def test_other_activities_are_refused_left_out_or_taken_as_found(source):
    add_trial(source, 2, 3, 1, "wavng_hand")
    add_trial(source, 2, 3, 1, "using_phone")
    message = refuse(source)
    assert message.startswith(
        f"{source}/video/subject02/cam1/scene3/session1/wavng_hand.mp4: unknown activity 'wavng_hand'"
    )
    assert "did you mean 'waving_hand'?" in message and "--leave_out wavng_hand goes without it" in message
    assert set(names(convert(source, leave_out="wavng_hand"), "activity")) == {"walking", "using_phone_desk"}
    found = convert(source, activities="found")
    assert json.loads(found.attributes["classes"])["activity"] == ["using_phone", "walking", "wavng_hand"]
    assert (found.attributes["environment"], found.attributes["licence"]) == ("unknown", "unknown")
    found.path.unlink()
    assert "--leave_out: no file is called 'wavin'" in refuse(source, leave_out="wavin")


def test_each_split_holds_out_its_own_clips(tmp_path, capsys):
    source = write_tree(tmp_path / "MMAct", subjects=(2, 20), sessions=(5, 10), cameras=(1, 4))
    add_trial(source, 2, 2, 1, "walking", cameras=(1, 4))
    options = {"views": "cam1,cam4"}

    def held(split: str, **more) -> list[tuple[str, ...]]:
        store = convert(source, split=split, **options, **more)
        factors = ("subject", "scene", "session", *(("camera",) if more else ()))
        rows = list(zip(*(names(store, factor) for factor in factors), strict=True))
        return [row for row, test in zip(rows, store.evaluation, strict=True) if test]

    assert held("cross_subject") == [("20", "1", "5"), ("20", "1", "10")]
    assert held("cross_session") == [("2", "1", "5"), ("20", "1", "5")]
    assert held("cross_scene") == [("2", "2", "1")]
    assert [row[3] for row in held("cross_view", cameras_apart=True)] == ["4"] * 5
    assert "cross_view: clips to test on share their sensors with clips to train on" in capsys.readouterr().err
    with h5py.File(convert(source, split="none", **options).path) as file:
        assert not file["episodes/evaluation"][:].any()


def test_cameras_apart_are_clips_of_one_recording(source, capsys):
    store = convert(source, cameras_apart=True, split="cross_session")
    assert "share their sensors" not in capsys.readouterr().err
    assert set(store.observations) == {"camera", "acceleration", "gyroscope", "orientation"}
    assert names(store, "camera") == ["1", "3"] * 4
    assert store.recordings.tolist() == [0, 0, 1, 1, 2, 2, 3, 3]
    assert abs(brightness(store, "camera", 1)[0] - brightness(store, "camera", 0)[0] - 2) <= 1
    sensors = store.array("observations/gyroscope")
    assert (sensors[::2] == sensors[1::2]).all()
    for folder in (source / "video/subject01/cam1", source / "video/subject01/cam3"):
        (folder / "scene1/session1/walking.mp4").unlink()
    capsys.readouterr()
    assert convert(source, cameras_apart=True).rows == 6
    line = "left out subject 1, scene 1, session 1, walking: none of the chosen cameras has a video of it"
    assert line in capsys.readouterr().err.splitlines()
    (source / "video/subject17/cam1/scene1/session1/walking.mp4").unlink()
    assert convert(source, sensors="none", views="cam1").rows == 2
    assert line.replace("subject 1,", "subject 17,") in capsys.readouterr().err.splitlines()


def test_a_split_without_clips_to_test_or_train_on_is_refused(tmp_path):
    source = write_tree(tmp_path / "MMAct", subjects=(1, 2, 3, 5), sessions=(1, 5))
    assert refuse(source) == (
        "--split cross_subject: no test subject (17-20) among the subjects found: 1-3, 5; choices: cross_session, none"
    )
    assert "cross_scene: no test scene (2) among the scenes found: 1;" in refuse(source, split="cross_scene")
    assert "pass --cameras_apart" in refuse(source, split="cross_view")
    message = refuse(source, split="cross_view", cameras_apart=True)
    assert "no test camera (4) among the cameras found: 1, 3;" in message
    tested = write_tree(tmp_path / "test", subjects=(17, 19), sessions=(5,))
    assert "no training subject (any but 17-20) among the subjects found: 17, 19; choices: none" in refuse(tested)
    assert in_ranges([3, 1, 2, 5, 8, 7]) == "1-3, 5, 7-8"


def test_views_and_sensors_are_chosen(source):
    assert list(convert(source, views="cam3", sensors="gyroscope").observations) == ["cam3", "gyroscope"]
    assert list(convert(source, views="none").observations) == ["acceleration", "gyroscope", "orientation"]
    assert list(convert(source, views="all", sensors="none").observations) == ["cam1", "cam3"]
    (source / "video").rename(source.parent / "films")
    assert list(convert(source, videos=source.parent / "films", sensors="none").observations) == ["cam1", "cam3"]
    (source.parent / "out/store.h5").unlink()
    assert refuse(source) == (
        f"{source}/video: no such folder; name the folder of videos with --videos, or pass --views none"
    )
    films = source.parent / "films"
    message = refuse(source, videos=films, views="cam1,cam2")
    assert message.startswith(f"--views: {films} has no camera 'cam2', did you mean 'cam")
    assert "--sensors: unknown 'gyro', did you mean 'gyroscope'?" in refuse(source, sensors="gyro")
    (source / "gyro_clip").rename(source / "gyro")
    message = refuse(source, videos=films)
    assert message == f"{source}: holds no folder gyro_clip; --sensors acceleration,orientation goes without gyroscope"
    assert "nothing to read" in refuse(source, views="none", sensors="none")


def test_a_watch_with_more_sensors_than_the_published_one_comes_first(source):
    for session in (1, 5):
        place = f"subject17/scene1/session{session}/walking.csv"
        write_sensor(source / "gyro_watch_clip" / place, sensor_lines(50, offset=50))
    store = convert(source)
    gyroscope = store.array("observations/gyroscope")
    assert gyroscope.shape == (4, 8, 6) and store.observations["orientation"].shape == (8, 3)
    assert gyroscope[2, 0, [0, 3]].tolist() == [50, 17]
    assert np.isnan(gyroscope[:2, :, :3]).all() and np.isfinite(gyroscope[:2, :, 3:]).all()
    assert json.loads(store.attributes["channels"])["gyroscope"][2:4] == ["watch z", "phone x"]


def test_wrong_places_and_numbers_are_one_line(source):
    assert refuse(source.parent / "none") == f"{source.parent}/none: no such folder"
    assert refuse(source, size=0) == "--size must be at least 1, is 0"
    assert refuse(source, jobs=0) == "--jobs must be at least 1, is 0"
    assert refuse(source, rate=float("nan")) == "--rate must be above 0 and at most 1000, is nan"
    assert refuse(source, seconds=-1) == "--seconds must be above 0 and at most 1000, is -1"
    assert "no folder subjectNN/camN in it" in refuse(source, videos=source)
    twice = write_sensor(source / "gyro_clip/subject01/scene1/session1/walking.csv", sensor_lines(50))
    message = refuse(source)
    assert "subject1/scene1/session1/walking.csv: belongs where" in message and str(twice) in message


def test_the_verb_imports_and_inspects(source, capsys):
    out = source.parent / "s.h5"
    words = [
        "mmact",
        str(source),
        str(out),
        "--size",
        "8",
        "--segments",
        "2",
        "--jobs",
        "1",
        "--split",
        "cross_session",
    ]
    assert main(["import", *words]) == 0
    assert capsys.readouterr().out == f"wrote {out}\n"
    store = EpisodeStore(out)
    assert store.observations["cam1"].shape == (4, 3, 8, 8) and store.evaluation.tolist() == [False, True] * 2
    more = ["--views", "none", "--sensors", "gyroscope", "--split", "none", "--seconds", "1", "--overwrite"]
    assert main(["import", *words[:3], *more]) == 0
    store = EpisodeStore(out)
    assert {name: spec.shape for name, spec in store.observations.items()} == {"gyroscope": (25, 3)}
    assert main(["import", *words]) == 2
    assert "exists already" in capsys.readouterr().err
