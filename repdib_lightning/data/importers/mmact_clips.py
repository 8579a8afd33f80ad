"""Clips of trials: what is known of them before anything is decoded, and their arrays."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from repdib_lightning.data.importers.mmact_notes import Note, UnreadableFile
from repdib_lightning.data.importers.mmact_sensors import WIDTH, read_stream, resample
from repdib_lightning.data.importers.mmact_trials import ANGLES, Trial
from repdib_lightning.data.importers.mmact_videos import check_video, read_film
from repdib_lightning.records import ArraySpec


@dataclass(frozen=True)
class Clip:
    """One episode of the store.

    Attributes:
        trial: whose sensors it has.
        recording: number of the trial.
        videos: view -> file; None where there is none.
        camera: number of the one camera, or None: the clip has every view.
    """

    trial: Trial
    recording: int
    videos: dict[str, Path | None]
    camera: int | None = None

    @property
    def factors(self) -> dict[str, int]:
        """All but the activity, as numbers of the folders."""
        trial = self.trial
        numbers = {"subject": trial.subject, "scene": trial.scene, "session": trial.session}
        return numbers if self.camera is None else {**numbers, "camera": self.camera}

    def __str__(self) -> str:
        return str(self.trial) if self.camera is None else f"{self.trial}, camera {self.camera}"


@dataclass(frozen=True)
class Form:
    """The arrays of every clip.

    Attributes:
        views: observations from videos.
        sensors: observation -> folders of its streams, in the order of the channels -> where the sensor was worn.
        size: height and width of a frame. frames: kept of each video.
        rate: steps a second of the sensors. steps: of each clip.
    """

    views: tuple[str, ...]
    sensors: dict[str, dict[str, str]]
    size: int
    frames: int
    rate: float
    steps: int

    @property
    def observations(self) -> dict[str, ArraySpec]:
        """Name -> shape and dtype."""
        video = ArraySpec((self.frames, 3, self.size, self.size))
        widths = {name: WIDTH * len(folders) for name, folders in self.sensors.items()}
        sequences = {name: ArraySpec((self.steps, width), "float32") for name, width in widths.items()}
        return {**dict.fromkeys(self.views, video), **sequences}


@dataclass(frozen=True)
class SensorScan:
    """Of one trial: steps of the longest readable stream (0: none is readable), and what is wrong with the others."""

    steps: int
    notes: list[Note]


def cut_clips(trials: Sequence[Trial], cameras: Sequence[int], *, apart: bool) -> tuple[list[Clip], list[Note]]:
    """A clip a trial with all cameras, or a clip for each video of the cameras; and which trials have none."""
    clips, notes = [], []
    for number, trial in enumerate(trials):
        seen_by = [camera for camera in cameras if camera in trial.videos]
        if apart:
            clips += [Clip(trial, number, {"camera": trial.videos[camera]}, camera) for camera in seen_by]
        elif seen_by or trial.sensors:
            clips.append(Clip(trial, number, {f"cam{camera}": trial.videos.get(camera) for camera in cameras}))
        if not seen_by and (apart or not trial.sensors):
            notes.append(Note("left out", str(trial), "none of the chosen cameras has a video of it"))
    return clips, notes


def scan_sensors(trial: Trial, rate: float) -> SensorScan:
    """Read all sensors of a trial."""
    steps, notes = 0, []
    for file in trial.sensors.values():
        try:
            steps = max(steps, read_stream(file).steps(rate))
        except UnreadableFile as error:
            notes.append(Note("skipped", str(file), str(error)))
    return SensorScan(steps, notes)


def unreadable_videos(clip: Clip) -> list[Note] | None:
    """What is wrong with each video of a clip; None if one of them gives a frame."""
    notes = []
    for file in clip.videos.values():
        if file is not None:
            try:
                check_video(file)
            except UnreadableFile as error:
                notes.append(Note("skipped", str(file), str(error)))
            else:
                return None
    return notes


def read_clip(clip: Clip, form: Form) -> tuple[dict[str, np.ndarray], list[Note]]:
    """Arrays of one row, name -> (1, ...), zeros or NaN where something is missing; and what is wrong with the videos.

    What is wrong with the sensors, :func:`scan_sensors` tells.
    """
    notes: list[Note] = []
    arrays = {name: _film(clip.videos[name], form, notes) for name in form.views}
    for name, folders in form.sensors.items():
        arrays[name] = np.concatenate(
            [_readings(clip.trial, part, form, angles=name in ANGLES) for part in folders], axis=1
        )
    return {name: array[None] for name, array in arrays.items()}, notes


def _film(file: Path | None, form: Form, notes: list[Note]) -> np.ndarray:
    """(T, 3, H, W) uint8."""
    missing = np.zeros((form.frames, 3, form.size, form.size), np.uint8)
    if file is None:
        return missing
    try:
        film = read_film(file, form.size, form.frames)
    except UnreadableFile as error:
        notes.append(Note("skipped", str(file), str(error)))
        return missing
    if film.broken:
        notes.append(Note("broken", str(file), f"breaks off after {film.decoded} frames ({film.broken})"))
    if film.decoded < form.frames:
        notes.append(Note("short", str(file), f"{film.decoded} frames for {form.frames} places, some are repeated"))
    return film.frames


def _readings(trial: Trial, part: str, form: Form, *, angles: bool) -> np.ndarray:
    """(T, 3) float32 of one folder."""
    if part in trial.sensors:
        try:
            return resample(read_stream(trial.sensors[part]), form.rate, form.steps, angles=angles)
        except UnreadableFile:
            pass
    return np.full((form.steps, WIDTH), np.nan, np.float32)
