"""Makes data sets of simulated people: worker processes film and measure them, and one store or folder is written."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Any

from repdib_lightning.data.schema import FactorSpec
from repdib_lightning.data.writer import EpisodeWriter
from repdib_lightning.environments.activity_body import CAMERAS
from repdib_lightning.environments.activity_folder import FolderRecording, whole_folder
from repdib_lightning.environments.activity_motions import SCRIPTS
from repdib_lightning.environments.activity_recording import STEPS, STORED_RATE, ActivityRecording
from repdib_lightning.environments.activity_sensors import DEVICES, SENSORS
from repdib_lightning.environments.episode_workers import recorded_in_order
from repdib_lightning.errors import UserError
from repdib_lightning.records import ArraySpec

_CLIPS = 2000


def collect_activities(
    path: Path,
    *,
    clips: int | None = None,
    subjects: int = 20,
    sessions: int = 5,
    activities: str | None = None,
    size: int = 64,
    frames: int = 16,
    seed: int = 0,
    workers: int = 2,
    folder: bool = False,
    overwrite: bool = False,
    progress: bool = True,
) -> Path:
    """Record simulated people doing everyday activities, in the manner of MMAct (paper, activity recognition).

    Observations of a clip: ``cam1`` and ``cam2``, which stand opposite each other, (frames, 3, size, size) uint8;
    ``acceleration`` (m/s^2, with gravity), ``gyroscope`` (rad/s) and ``orientation`` (degrees), (100, 6) float32, of a
    watch and a phone at 25 Hz. What is missing, or lies beyond the clip's end, is zeros or NaN. Factors: ``activity``
    (endogenous), ``subject``, ``session`` and ``handedness``. Every combination of subject, session and activity comes
    as often as any other. The last fifth of the people (17-20 of 20) are marked for evaluation.

    People differ in build, speed, reach, posture, habits, clothes and in how they wear watch and phone; sessions in
    room, light and cameras. A clip depends on the seed and its number, whatever ``workers`` is. What was interrupted
    goes on after its last clip when the same command is given again; a folder begins anew.

    Args:
        path: the file to make.
        clips: by default 2,000, or with ``folder`` every combination once.
        subjects: people.
        sessions: visits of each.
        activities: names, comma-separated; by default all 16.
        size: height and width of the pictures, 16 to 512.
        frames: of each view, in the middle of as many even parts of the clip; a folder has 30 a second.
        seed: of everything.
        workers: rendering processes, one a core is best.
        folder: write a folder of mp4 and CSV files in MMAct's own form, for ``import mmact``.
        overwrite: replace an existing file, and what an interrupted recording left.
        progress: show a progress bar.

    Returns:
        The path.

    Raises:
        UserError: an option out of range, an unknown activity, a file that exists or cannot be written, the rest of
            another recording, no renderer.
    """
    if workers < 1:
        raise UserError(f"workers={workers}: must be at least 1")
    names = tuple(SCRIPTS) if activities is None else tuple(name.strip() for name in activities.split(","))
    if clips is None:
        clips = max(subjects, 1) * max(sessions, 1) * len(names) if folder else _CLIPS
    recording = ActivityRecording(clips, subjects, sessions, names, size, frames, seed)
    if folder:
        _write_folder(Path(path), recording, workers, overwrite, progress)
    else:
        _write_store(Path(path), recording, workers, overwrite, progress)
    return Path(path)


def _write_store(path: Path, recording: ActivityRecording, workers: int, overwrite: bool, progress: bool) -> None:
    writer = EpisodeWriter(
        path,
        rows=recording.clips,
        episodes=recording.clips,
        observations={
            **dict.fromkeys(CAMERAS, ArraySpec((recording.frames, 3, recording.size, recording.size))),
            **dict.fromkeys(SENSORS, ArraySpec((STEPS, len(DEVICES) * 3), "float32")),
        },
        actions=None,
        factors={
            "activity": FactorSpec("endogenous", "categorical", len(recording.activities)),
            "subject": FactorSpec("exogenous", "categorical", recording.subjects),
            "session": FactorSpec("exogenous", "categorical", recording.sessions),
            "handedness": FactorSpec("exogenous", "categorical", 2),
        },
        attributes=_attributes(recording),
        overwrite=overwrite,
        resume=True,
    )
    rest = range(writer.episodes_done, recording.clips)
    with writer, _progress_bar(recording, writer.episodes_done, progress) as bar:
        for clip in recorded_in_order(recording, rest, workers):
            writer.add_episode(**clip)
            bar.update()


def _write_folder(path: Path, recording: ActivityRecording, workers: int, overwrite: bool, progress: bool) -> None:
    FolderRecording(recording, path)  # what is wrong with the options shows before anything is made
    with whole_folder(path, overwrite=overwrite) as aside, _progress_bar(recording, 0, progress) as bar:
        for _ in recorded_in_order(FolderRecording(recording, aside), range(recording.clips), workers):
            bar.update()


def _attributes(recording: ActivityRecording) -> dict[str, Any]:
    return {
        "environment": "activities",
        "configuration": asdict(recording),
        "classes": {
            "activity": list(recording.activities),
            "subject": [str(number + 1) for number in range(recording.subjects)],
            "session": [str(number + 1) for number in range(recording.sessions)],
            "handedness": ["right", "left"],
        },
        "channels": {
            sensor: [f"{device} {channel}" for device in DEVICES for channel in channels]
            for sensor, channels in SENSORS.items()
        },
        "rate": dict.fromkeys(SENSORS, STORED_RATE),
        "seed": recording.seed,
        "licence": "generated",
    }


def _progress_bar(recording: ActivityRecording, done: int, shown: bool) -> Any:
    from tqdm import tqdm

    return tqdm(total=recording.clips, initial=done, unit=" clips", desc="activities", disable=None if shown else True)
