"""Recording simulated people: the same clips whatever the number of workers, balanced, with honest gaps."""

from __future__ import annotations

import json
import re
from contextlib import contextmanager
from datetime import datetime
from pathlib import Path
from typing import Any

import av
import numpy as np
import pytest

from repdib_lightning.data.episodes import EpisodeStore
from repdib_lightning.environments import collect_activities as collecting
from repdib_lightning.environments.activity_motions import SCRIPTS
from repdib_lightning.environments.activity_people import session
from repdib_lightning.environments.activity_recording import ActivityRecording, Studio, balanced_plan, stored_clip
from repdib_lightning.environments.activity_stage import Pillar
from repdib_lightning.environments.collect_activities import collect_activities
from repdib_lightning.errors import UserError

CAMERAS = ("cam1", "cam2")
SENSORS = ("acceleration", "gyroscope", "orientation")
CHOSEN = ("walking", "sitting_down", "drinking")
SMALL: dict[str, Any] = {
    "clips": 90, "subjects": 5, "sessions": 2, "activities": ",".join(CHOSEN), "size": 16, "frames": 3, "seed": 4,
    "progress": False,
}  # fmt: skip
TINY = {**SMALL, "clips": 6}


def columns(path: Path) -> dict[str, np.ndarray]:
    """Key -> everything of a store."""
    store = EpisodeStore(path)
    keys = [f"observations/{name}" for name in store.observations] + [f"factors/{name}" for name in store.factors]
    return {key: np.asarray(store.gather(key, np.arange(store.rows))) for key in keys}


@pytest.fixture(scope="module")
def path(tmp_path_factory) -> Path:
    return collect_activities(tmp_path_factory.mktemp("people") / "people.h5", workers=1, **SMALL)


@pytest.fixture(scope="module")
def found(path) -> dict[str, np.ndarray]:
    return columns(path)


@pytest.fixture(scope="module")
def recording() -> ActivityRecording:
    return ActivityRecording(90, 5, 2, CHOSEN, 16, 3, 4)


@pytest.fixture(scope="module")
def studio(recording):
    studio = Studio(recording)
    yield studio
    studio.stage.close()


@pytest.fixture
def in_this_process(monkeypatch):
    """Inside of it, clips are recorded without starting another process."""

    @contextmanager
    def entered():
        with monkeypatch.context() as patch:
            patch.setattr(collecting, "recorded_in_order", lambda recording, clips, _: map(recording.open(), clips))
            yield

    return entered


def test_layout(path, found):
    store = EpisodeStore(path)
    assert (store.rows, len(store.lengths)) == (90, 90) and store.actions_spec is None
    assert {name: (spec.shape, spec.dtype) for name, spec in store.observations.items()} == {
        **dict.fromkeys(CAMERAS, ((3, 3, 16, 16), "uint8")),
        **dict.fromkeys(SENSORS, ((100, 6), "float32")),
    }
    assert {name: (spec.kind, spec.classes) for name, spec in store.factors.items()} == {
        "activity": ("endogenous", 3),
        "subject": ("exogenous", 5),
        "session": ("exogenous", 2),
        "handedness": ("exogenous", 2),
    }
    attributes = {name: json.loads(store.attributes[name]) for name in ("classes", "channels", "rate", "configuration")}
    assert attributes["classes"]["activity"] == list(CHOSEN)
    assert attributes["classes"]["subject"] == ["1", "2", "3", "4", "5"]
    assert attributes["channels"]["orientation"][:4] == ["watch azimuth", "watch pitch", "watch roll", "phone azimuth"]
    assert attributes["rate"] == dict.fromkeys(SENSORS, 25)
    assert (attributes["configuration"]["clips"], attributes["configuration"]["seed"]) == (90, 4)
    assert (store.attributes["environment"], store.attributes["licence"]) == ("activities", "generated")
    assert np.array_equal(store.evaluation, found["factors/subject"] == 4), "the last fifth of the people"


def test_two_workers_write_the_same_bytes_and_another_seed_does_not(tmp_path, studio, in_this_process):
    two = collect_activities(tmp_path / "two.h5", workers=2, **TINY)
    with in_this_process():
        one = collect_activities(tmp_path / "one.h5", **TINY)
        other = collect_activities(tmp_path / "other.h5", **{**TINY, "seed": 5})
    assert one.read_bytes() == two.read_bytes()
    assert not np.array_equal(columns(one)["observations/cam1"], columns(other)["observations/cam1"])


def test_a_clip_depends_on_seed_and_number_alone(found, recording, studio):
    for number in (40, 7):
        clip = stored_clip(recording, studio, number)
        for name, values in clip["observations"].items():
            assert np.array_equal(values[0], found[f"observations/{name}"][number], equal_nan=True), name


def test_what_is_missing_is_zeros_or_nan_and_nothing_else_is(found):
    for name in CAMERAS:
        seen = found[f"observations/{name}"].any(axis=(2, 3, 4))
        assert (seen.all(axis=1) | ~seen.any(axis=1)).all(), "a camera is missing for a whole clip"
        assert 0 < (~seen).mean() < 0.15
    ends = []
    for name in SENSORS:
        observed = np.isfinite(found[f"observations/{name}"]).reshape(90, 100, 2, 3)
        assert (observed.all(axis=-1) == observed.any(axis=-1)).all(), "a device has all three axes or none"
        assert (np.diff(observed.astype(int), axis=1) <= 0).all(), "and all steps until the end of the clip"
        assert 0 < (~observed[:, 0]).mean() < 0.2
        ends.append(observed.any(axis=(2, 3)).sum(axis=1))
    lengths = np.max(ends, axis=0)
    assert all(((end == lengths) | (end == 0)).all() for end in ends), "the sensors of a clip end together"
    assert lengths[lengths > 0].min() < 60 and lengths.max() > 80, "clips are of many lengths"


def test_readings_are_of_the_right_size(found):
    """At rest, on average, a device reads gravity; nobody turns for long."""
    drinking = found["factors/activity"] == CHOSEN.index("drinking")
    strength = np.linalg.norm(found["observations/acceleration"][drinking][..., 3:], axis=-1)
    assert abs(np.nanmedian(strength) - 9.81) < 0.3
    walking = found["factors/activity"] == CHOSEN.index("walking")
    shaken = [np.nanstd(found["observations/acceleration"][rows][..., 3:]) for rows in (walking, drinking)]
    turned = [np.nanstd(found["observations/gyroscope"][rows][..., 3:]) for rows in (walking, drinking)]
    assert turned[0] > 3 * turned[1] and shaken[0] > 0


def test_the_handedness_is_the_subjects(found):
    pairs = set(zip(found["factors/subject"], found["factors/handedness"], strict=True))
    assert len(pairs) == 5 and sum(hand for _, hand in pairs) == 1


@pytest.mark.parametrize(
    ("clips", "subjects", "sessions", "activities"),
    [(2000, 20, 5, 16), (1600, 20, 5, 16), (90, 5, 2, 3), (333, 7, 3, 4), (41, 20, 5, 16)],
)
def test_the_plan_is_balanced_and_shuffled(clips, subjects, sessions, activities):
    plan = np.array(
        [(t.subject, t.session, t.activity) for t in balanced_plan(clips, subjects, sessions, activities, 0)]
    )
    sizes = (subjects, sessions, activities)
    combinations = np.zeros(sizes, int)
    np.add.at(combinations, tuple(plan.T), 1)
    assert combinations.sum() == clips and np.ptp(combinations) <= 1
    for factor in (0, 2):
        assert np.ptp(combinations.sum(axis=tuple({0, 1, 2} - {factor}))) <= 1
    assert np.ptp(combinations.sum(axis=(0, 2))) <= max(2, clips // 200)
    if clips >= 1600:
        pairs = {(0, 1): 2, (0, 2): 1, (1, 2): 2}  # counts differ by at most so many
        assert all(np.ptp(combinations.sum(axis=3 - a - b)) <= most for (a, b), most in pairs.items())
        for every in (2, 5):
            picked = np.bincount(plan[::every, 2], minlength=activities) * every / clips * activities
            assert np.abs(picked - 1).max() < 0.5, "every n-th clip is any activity"


def test_frames_are_spread_over_the_clip_and_show_the_movement(recording, studio):
    number = next(n for n, t in enumerate(recording.plan) if CHOSEN[t.activity] == "walking")
    clip = studio.clip(number)
    moments = np.array([0, 20, 40])
    seen = clip.film(moments)
    for frames in seen.values():
        assert frames.shape == (3, 3, 16, 16) and frames.dtype == np.uint8
        assert (np.abs(np.diff(frames.astype(int), axis=0)) > 20).any(axis=(1, 2, 3)).all()
    assert np.array_equal(clip.film(moments[::-1])["cam1"], seen["cam1"][::-1]), "a picture depends on its moment alone"


def test_a_pillar_hides_one_camera_for_a_while(recording, studio):
    number = next(n for n, t in enumerate(recording.plan) if CHOSEN[t.activity] == "drinking")
    played = studio.clip(number).performance
    subject = recording.plan[number].subject
    body, look, moments = studio.body(subject), session(4, 0, subject), np.arange(0, len(played), len(played) // 10)
    pillar = Pillar("cam2", (0.35, 0.75), 0.0, 1.0, 0.5)
    free = studio.stage.film(body, played, look, moments)
    hidden = studio.stage.film(body, played, look, moments, pillars=(pillar,))
    changed = [(free[name] != hidden[name]).any(axis=1).mean(axis=(1, 2)) for name in CAMERAS]
    assert not changed[0].any(), "the other camera sees nothing of it"
    there = (moments / len(played) >= 0.35) & (moments / len(played) < 0.75)
    assert (changed[1][there] > 0.15).all() and not changed[1][~there].any()


def test_an_interrupted_recording_goes_on(tmp_path, monkeypatch, in_this_process):
    asked = []

    def interrupted(recording, clips, _):
        asked.append(clips)
        record = recording.open()
        for number in clips:
            if number == 4 and len(asked) == 1:
                raise KeyboardInterrupt
            yield record(number)

    with in_this_process():
        whole = collect_activities(tmp_path / "whole.h5", **TINY)
    monkeypatch.setattr(collecting, "recorded_in_order", interrupted)
    with pytest.raises(KeyboardInterrupt):
        collect_activities(tmp_path / "rest.h5", **TINY)
    rest = collect_activities(tmp_path / "rest.h5", **TINY)
    assert asked == [range(6), range(4, 6)] and rest.read_bytes() == whole.read_bytes()


@pytest.mark.parametrize(
    ("option", "said"),
    [
        ({"clips": 0}, "clips=0: must be in 1"),
        ({"subjects": 0}, "subjects=0: must be in 1"),
        ({"sessions": -1}, "sessions=-1: must be in 1"),
        ({"size": 8}, "size=8: must be in 16 to 512"),
        ({"frames": 0}, "frames=0: must be in 1"),
        ({"seed": -1}, "seed=-1: must be in 0"),
        ({"workers": 0}, "workers=0: must be at least 1"),
        ({"activities": "walking,juming"}, "unknown activity 'juming', did you mean 'jumping'"),
        ({"activities": "walking"}, "at least 2, each named once"),
        ({"activities": "walking,walking"}, "at least 2, each named once"),
        ({"folder": True, "clips": 31}, "clips=31: a folder holds every trial once, at most 30"),
        ({"folder": True, "size": 17, "clips": 2}, "size=17: must be even"),
    ],
)
def test_bad_options_are_named(tmp_path, option, said):
    with pytest.raises(UserError, match=re.escape(said)):
        collect_activities(tmp_path / "x", **{**SMALL, **option})
    assert not list(tmp_path.iterdir())


def test_who_is_held_out():
    for subjects, expected in ((20, {16, 17, 18, 19}), (5, {4}), (2, {1}), (1, set())):
        recording = ActivityRecording(40, subjects, 2, tuple(SCRIPTS), 16, 1, 0)
        assert {t.subject for t in recording.plan if recording.held_out(t)} == expected


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("people") / "mmact"
    options = {**SMALL, "clips": None, "subjects": 2, "size": 32}
    return collect_activities(path, folder=True, workers=2, **options)


def test_a_folder_has_every_trial_in_the_form_of_mmact(folder):
    trials = {f"subject{s}/scene1/session{v}/{a}" for s in (1, 2) for v in (1, 2) for a in CHOSEN}
    assert {entry.name for entry in folder.iterdir()} == {
        "video", "acc_watch_clip", "acc_phone_clip", "gyro_clip", "gyro_watch_clip", "orientation_clip",
        "orientation_watch_clip",
    }  # fmt: skip
    for kind in ("acc_watch_clip", "gyro_clip", "orientation_clip"):
        files = {str(file.relative_to(folder / kind).with_suffix("")) for file in (folder / kind).rglob("*.csv")}
        assert files <= trials and len(files) >= 10, kind
    videos = {str(file.relative_to(folder / "video").with_suffix("")) for file in (folder / "video").rglob("*.mp4")}
    padded = {t.replace("subject", "subject0").replace("scene1", f"{c}/scene1") for t in trials for c in CAMERAS}
    assert videos <= padded and len(videos) >= 20


def test_files_of_a_folder_are_of_one_length_and_hold_the_same_people(folder):
    recording = ActivityRecording(12, 2, 2, CHOSEN, 32, 3, 4)
    studio = Studio(recording)
    for number in range(4):
        clip = studio.clip(number)
        trial, seconds = clip.trial, len(clip.performance) / 100
        inner = f"scene1/session{trial.session + 1}/{CHOSEN[trial.activity]}"
        acceleration = folder / "acc_phone_clip" / f"subject{trial.subject + 1}" / f"{inner}.csv"
        if acceleration.is_file():
            rows = [line.split(",") for line in acceleration.read_text().splitlines()]
            times = [datetime.strptime(row[0], "%Y%m%d_%H:%M:%S.%f").timestamp() for row in rows]
            assert np.allclose(np.diff(times), 0.01, atol=1e-5)
            assert np.allclose(np.array(rows)[:, 1:].astype(float), clip.readings["acceleration"][:, 1], atol=1e-5)
        gyroscope = folder / "gyro_clip" / f"subject{trial.subject + 1}" / f"{inner}.csv"
        if gyroscope.is_file():
            assert len(gyroscope.read_text().splitlines()) == len(clip.performance) // 2
        video = folder / "video" / f"subject{trial.subject + 1:02d}" / "cam1" / f"{inner}.mp4"
        if video.is_file():
            with av.open(str(video)) as container:
                assert container.streams.video[0].average_rate == 30
                frames = [frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)]
            assert len(frames) == int(seconds * 30)
            drawn = clip.film(np.array([10]))["cam1"][0].transpose(1, 2, 0)
            assert np.abs(frames[3].astype(int) - drawn).mean() < 12
    studio.stage.close()


def test_a_folder_can_be_imported(folder, tmp_path):
    from repdib_lightning.data.importers.mmact import import_mmact

    views = ",".join(CAMERAS)
    imported = import_mmact(
        folder, tmp_path / "people.h5", views=views, split="none", activities="found", size=32, jobs=1, progress=False
    )
    store = EpisodeStore(imported)
    assert store.rows == 12 and set(store.observations) == {*CAMERAS, *SENSORS}
    assert json.loads(store.attributes["classes"])["activity"] == sorted(CHOSEN)


def test_a_folder_is_replaced_only_when_it_is_one(folder, tmp_path, in_this_process):
    options = {**TINY, "clips": 1, "folder": True}
    with pytest.raises(UserError, match="exists already"):
        collect_activities(folder, **options)
    mine = tmp_path / "mine"
    mine.mkdir()
    (mine / "thesis.txt").write_text("mine")
    with pytest.raises(UserError, match="replaces only a folder that"):
        collect_activities(mine, overwrite=True, **options)
    assert (mine / "thesis.txt").read_text() == "mine"
    with in_this_process():
        ours = collect_activities(tmp_path / "ours", **options)
        (ours / "video" / "old").mkdir()
        collect_activities(ours, overwrite=True, **options)
    assert not (ours / "video" / "old").exists()
    assert sorted(entry.name for entry in tmp_path.iterdir()) == ["mine", "ours"]


def test_a_broken_off_folder_leaves_nothing(tmp_path, monkeypatch):
    def broken(*_):
        raise KeyboardInterrupt
        yield

    monkeypatch.setattr(collecting, "recorded_in_order", broken)
    with pytest.raises(KeyboardInterrupt):
        collect_activities(tmp_path / "x", **{**TINY, "folder": True})
    assert not list(tmp_path.iterdir())
