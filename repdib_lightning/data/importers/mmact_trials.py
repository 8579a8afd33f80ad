"""Finds the trials of MMAct's folders: which video and sensor files belong to one performance of an activity.

::

    VIDEOS/subjectNN/cam{1..4}/scene{1..4}/session{1..5}/<activity>.mp4
    SOURCE/{acc_watch_clip,acc_phone_clip,gyro_clip,orientation_clip}/subjectN/scene?/session?/<activity>.csv

Folders of the same form may have gyro_watch_clip and orientation_watch_clip, too. Numbers are read as integers (videos
have subject01 where sensors have subject1), activities in lower case.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from repdib_lightning.data.importers.mmact_notes import Note
from repdib_lightning.errors import UserError, nearest

VIDEO_LEVELS = ("subject", "cam", "scene", "session")
SENSOR_LEVELS = ("subject", "scene", "session")
VIDEO_LAYOUT = "subjectNN/cam{1..4}/scene{1..4}/session{1..5}/<activity>.mp4"
SENSORS: dict[str, dict[str, str]] = {
    "acceleration": {"acc_watch_clip": "watch", "acc_phone_clip": "phone"},
    "gyroscope": {"gyro_watch_clip": "watch", "gyro_clip": "phone"},
    "orientation": {"orientation_watch_clip": "watch", "orientation_clip": "phone"},
}
"""Observation -> folders of its streams -> where the sensor was worn."""
ANGLES = ("orientation",)
_NOT_IN_MMACT = ("gyro_watch_clip", "orientation_watch_clip")


@dataclass(frozen=True)
class Trial:
    """One person doing one activity once.

    Attributes:
        videos: number of the camera -> file.
        sensors: folder such as ``gyro_clip`` -> file.
    """

    subject: int
    scene: int
    session: int
    activity: str
    videos: dict[int, Path] = field(default_factory=dict, compare=False)
    sensors: dict[str, Path] = field(default_factory=dict, compare=False)

    def __str__(self) -> str:
        return f"subject {self.subject}, scene {self.scene}, session {self.session}, {self.activity}"


@dataclass(frozen=True)
class Found:
    """The trials in the order of subject, scene, session and activity, and what of the folders was not read."""

    trials: list[Trial]
    notes: list[Note]


def find_trials(source: Path, videos: Path | None, folders: Sequence[str]) -> Found:
    """Look through the folders of videos and sensors; no file is opened.

    Args:
        source: holds the folders of the sensors.
        videos: holds a folder for each subject; None: no videos are looked for.
        folders: of sensors, such as ``gyro_clip``; one that is not there has no files.

    Raises:
        UserError: a folder that cannot be read, or two files for the same place of a trial.
    """
    trials: dict[tuple[int, int, int, str], Trial] = {}
    notes: list[Note] = []
    if videos is not None:
        for (subject, camera, scene, session), activity, file in _files(videos, VIDEO_LEVELS, ".mp4", notes):
            trial = _trial(trials, subject, scene, session, activity)
            _place(trial.videos, camera, file)
    for name in folders:
        if (source / name).is_dir():
            for (subject, scene, session), activity, file in _files(source / name, SENSOR_LEVELS, ".csv", notes):
                _place(_trial(trials, subject, scene, session, activity).sensors, name, file)
    return Found([trials[key] for key in sorted(trials)], notes)


def cameras_in(videos: Path) -> list[int]:
    """Numbers of the cameras that any subject's folder has.

    Raises:
        UserError: there is none, or a folder cannot be read.
    """
    subjects = [folder for _, folder in _numbered(videos, "subject", [])]
    cameras = {number for folder in subjects for number, _ in _numbered(folder, "cam", [])}
    if not cameras:
        raise UserError(f"{videos}: no folder subjectNN/camN in it; expected {VIDEO_LAYOUT}")
    return sorted(cameras)


def choose_sensors(source: Path, words: str) -> dict[str, dict[str, str]]:
    """Those of ``SENSORS`` that ``--sensors`` names, without the streams that MMAct lacks and the source, too.

    Raises:
        UserError: an unknown one, or one of which there is no folder.
    """
    chosen = [] if words.strip() == "none" else [word.strip() for word in words.split(",")]
    for word in chosen:
        if word not in SENSORS:
            raise UserError(f"--sensors: unknown '{word}', {nearest(word, [*SENSORS, 'none'])}")
        if not any((source / name).is_dir() for name in SENSORS[word]):
            there = [name for name, parts in SENSORS.items() if any((source / part).is_dir() for part in parts)]
            others = ",".join(name for name in chosen if name in there) or "none"
            expected = " or ".join(name for name in SENSORS[word] if name not in _NOT_IN_MMACT)
            raise UserError(f"{source}: holds no folder {expected}; --sensors {others} goes without {word}")
    return {name: _streams(source, folders) for name, folders in SENSORS.items() if name in chosen}


def _streams(source: Path, folders: dict[str, str]) -> dict[str, str]:
    return {name: place for name, place in folders.items() if name not in _NOT_IN_MMACT or (source / name).is_dir()}


def choose_cameras(videos: Path, words: str) -> list[int]:
    """Numbers of the cameras of ``--views``: ``cam1,cam3``, ``all`` or ``none``.

    Raises:
        UserError: no such folder, or a camera that no subject has.
    """
    if words.strip() == "none":
        return []
    if not videos.is_dir():
        reason = "is a file" if videos.exists() else "no such folder"
        raise UserError(f"{videos}: {reason}; name the folder of videos with --videos, or pass --views none")
    there = cameras_in(videos)
    if words.strip() == "all":
        return there
    names = {f"cam{number}": number for number in there}
    chosen = []
    for word in (word.strip() for word in words.split(",")):
        if word not in names:
            raise UserError(f"--views: {videos} has no camera '{word}', {nearest(word, [*names, 'all', 'none'])}")
        chosen.append(names[word])
    return sorted(set(chosen))


def _trial(trials: dict[tuple[int, int, int, str], Trial], *key: int | str) -> Trial:
    return trials.setdefault(key, Trial(*key))  # type: ignore[arg-type]


def _place(files: dict, key: int | str, file: Path) -> None:
    if key in files:
        raise UserError(f"{file}: belongs where {files[key]} does (numbers and names in lower case agree); keep one")
    files[key] = file


def _files(
    root: Path, levels: Sequence[str], ending: str, notes: list[Note]
) -> Iterator[tuple[tuple[int, ...], str, Path]]:
    """Numbers of the levels, activity, file."""
    if levels:
        for number, folder in _numbered(root, levels[0], notes):
            for numbers, activity, file in _files(folder, levels[1:], ending, notes):
                yield (number, *numbers), activity, file
        return
    for entry in _visible(root):
        if entry.suffix.lower() == ending and entry.is_file():
            yield (), entry.stem.lower(), entry
        else:
            notes.append(Note("skipped", str(entry), f"is no {ending} file"))


def _numbered(root: Path, level: str, notes: list[Note]) -> Iterator[tuple[int, Path]]:
    for entry in _visible(root):
        named = re.fullmatch(rf"{level}_?(\d+)", entry.name, re.IGNORECASE | re.ASCII)
        if named and entry.is_dir():
            yield int(named[1]), entry
        else:
            notes.append(Note("skipped", str(entry), f"is no folder {level}N"))


def _visible(folder: Path) -> list[Path]:
    try:
        return sorted(entry for entry in folder.iterdir() if entry.name[0] not in "._")
    except OSError as error:
        raise UserError(f"{folder}: cannot be read ({error.strerror or error})") from error
