"""Simulated people as folders and files of MMAct's form: an mp4 for each camera and a CSV for each sensor of a trial.

::

    video/subjectNN/cam{1,2}/scene1/session{S}/{activity}.mp4        30 frames a second
    {acc,gyro,orientation}_*clip/subjectN/scene1/session{S}/{activity}.csv

The CSV files have no header; their rows are a time, ``YYYYMMDD_HH:MM:SS.ffffff``, and x, y, z. What is missing of a
trial has no file.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import datetime, timedelta
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from repdib_lightning.environments.activity_performance import RATE
from repdib_lightning.environments.activity_recording import ActivityRecording, Studio
from repdib_lightning.environments.activity_sensors import DEVICES, slower
from repdib_lightning.errors import UserError

VIDEO = "video"
FRAME_RATE = 30
FILES = {
    "acc_watch_clip": ("acceleration", "watch", 100),
    "acc_phone_clip": ("acceleration", "phone", 100),
    "gyro_watch_clip": ("gyroscope", "watch", 50),
    "gyro_clip": ("gyroscope", "phone", 50),
    "orientation_watch_clip": ("orientation", "watch", 50),
    "orientation_clip": ("orientation", "phone", 50),
}
"""Folder -> sensor, device, and rows a second."""


@dataclass(frozen=True)
class FolderRecording:
    """A recording whose trials are written to files by the processes that make them.

    Attributes:
        recording: which trials there are; no combination may come twice.
        folder: where they are written.
    """

    recording: ActivityRecording
    folder: Path

    def __post_init__(self) -> None:
        if self.recording.clips > self.recording.trials:
            raise UserError(
                f"clips={self.recording.clips}: a folder holds every trial once, at most {self.recording.trials} "
                "(subjects x sessions x activities)"
            )
        if self.recording.size % 2:
            raise UserError(f"size={self.recording.size}: must be even with --folder, as H.264 wants it")

    def open(self) -> Callable[[int], dict[str, Any]]:
        """Open the stage in this process: a function that writes the files of a trial."""
        return partial(write_trial, self, Studio(self.recording))


def write_trial(target: FolderRecording, studio: Studio, number: int) -> dict[str, Any]:
    """Write the videos and readings of a trial. Raises UserError where a file cannot be written."""
    recording, clip = target.recording, studio.clip(number)
    name, subject = recording.activities[clip.trial.activity], clip.trial.subject + 1
    inner = Path("scene1", f"session{clip.trial.session + 1}")
    count = int(len(clip.performance) * FRAME_RATE / RATE)
    moments = (np.arange(count) * RATE / FRAME_RATE).astype(np.int64)
    begun = datetime(2026, 1, 1 + subject % 28, 9 + clip.trial.session % 12) + timedelta(minutes=clip.trial.activity)
    try:
        for camera, frames in clip.film(moments).items():
            path = target.folder / VIDEO / f"subject{subject:02d}" / camera / inner / f"{name}.mp4"
            path.parent.mkdir(parents=True, exist_ok=True)
            _write_video(path, frames)
        for folder, (sensor, device, rate) in FILES.items():
            readings = slower(clip.readings[sensor], RATE // rate, sensor)[:, DEVICES.index(device)]
            if np.isfinite(readings).any():
                path = target.folder / folder / f"subject{subject}" / inner / f"{name}.csv"
                path.parent.mkdir(parents=True, exist_ok=True)
                _write_readings(path, readings, begun, rate)
    except OSError as error:
        raise UserError(f"{target.folder}: cannot be written ({error.strerror or error})") from error
    return {}


def _write_video(path: Path, frames: np.ndarray) -> None:
    """Encode (n, 3, H, W) uint8."""
    import av

    with av.open(str(path), "w") as container:
        stream: Any = container.add_stream("libx264", rate=FRAME_RATE, options={"crf": "16", "preset": "veryfast"})
        stream.height, stream.width = frames.shape[2:]
        stream.pix_fmt, stream.thread_count = "yuv420p", 1
        for frame in frames:
            picture = np.ascontiguousarray(frame.transpose(1, 2, 0))
            container.mux(stream.encode(av.VideoFrame.from_ndarray(picture, format="rgb24")))
        container.mux(stream.encode())


def _write_readings(path: Path, readings: np.ndarray, begun: datetime, rate: int) -> None:
    with path.open("w") as file:
        for step, (x, y, z) in enumerate(readings):
            now = begun + timedelta(seconds=step / rate)
            file.write(f"{now:%Y%m%d_%H:%M:%S.%f},{x:.6f},{y:.6f},{z:.6f}\n")


@contextmanager
def whole_folder(path: Path, *, overwrite: bool) -> Iterator[Path]:
    """A folder beside ``path`` to write to, which takes its place when all went well, and goes otherwise.

    Raises:
        UserError: the path exists without ``overwrite``, or is anything but a folder of this form; cannot be written.
    """
    if path.exists() and not overwrite:
        raise UserError(f"{path}: exists already; choose another folder or pass --overwrite")
    if path.exists() and not _has_our_form(path):
        raise UserError(f"{path}: --overwrite replaces only a folder that `collect activities --folder` has written")
    aside = path.with_name(f".{path.name}.unfinished")
    try:
        shutil.rmtree(aside, ignore_errors=True)
        aside.mkdir(parents=True)
        yield aside
        if path.exists():
            shutil.rmtree(path)
        aside.rename(path)
    except OSError as error:
        raise UserError(f"{path}: cannot be written ({error.strerror or error})") from error
    finally:
        shutil.rmtree(aside, ignore_errors=True)


def _has_our_form(path: Path) -> bool:
    return path.is_dir() and {entry.name for entry in path.iterdir()} <= {VIDEO, *FILES}
