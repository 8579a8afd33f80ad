"""Small folders in the form of MMAct: videos whose brightness tells the frame, sensors that are straight lines."""

from __future__ import annotations

from datetime import datetime, timedelta
from pathlib import Path
from typing import Any

import av
import numpy as np
import pytest

from repdib_lightning.data.episodes import EpisodeStore
from repdib_lightning.data.importers.mmact import import_mmact
from repdib_lightning.errors import UserError

FRAMES, STEP = 10, 20
RATES = {"acc_watch_clip": 100, "acc_phone_clip": 100, "gyro_clip": 50, "orientation_clip": 50}
SMALL = {"size": 8, "segments": 2, "per_segment": 2, "jobs": 1, "progress": False}


def write_video(file: Path, frames: int = FRAMES, width: int = 32, height: int = 16, first: int = STEP) -> Path:
    """Grey frames of brightness ``first``, ``first + 20``, ...; the outer quarters of their width are white."""
    file.parent.mkdir(parents=True, exist_ok=True)
    with av.open(str(file), "w", format="mp4") as container:
        stream = container.add_stream("libx264", rate=30, options={"qp": "0"})
        stream.width, stream.height, stream.pix_fmt = width, height, "yuv444p"
        for number in range(frames):
            picture = np.full((height, width, 3), first + STEP * number, np.uint8)
            picture[:, : width // 4] = picture[:, -width // 4 :] = 255
            container.mux(stream.encode(av.VideoFrame.from_ndarray(picture, format="rgb24")))
        container.mux(stream.encode())
    return file


def sensor_lines(rate: float, seconds: float = 0.3, offset: float = 0.0) -> list[str]:
    """x is the time in seconds plus ``offset``, y is -9.8, z is twice x; the clock passes midnight."""
    start = datetime(2019, 2, 28, 23, 59, 59, 900000)
    lines = []
    for number in range(round(seconds * rate) + 1):
        stamp = (start + timedelta(seconds=number / rate)).strftime("%Y%m%d_%H:%M:%S.%f")
        lines.append(f"{stamp},{number / rate + offset},-9.8,{2 * (number / rate + offset)}")
    return lines


def write_sensor(file: Path, lines: list[str]) -> Path:
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text("".join(f"{line}\n" for line in lines))
    return file


def write_tree(root: Path, subjects=(1, 17), sessions=(1, 5), activities=("walking",), cameras=(1, 3)) -> Path:
    """A trial a subject, session and activity, in scene 1; x of a sensor begins at the subject's number."""
    for subject in subjects:
        for session in sessions:
            for activity in activities:
                add_trial(root, subject, 1, session, activity, cameras)
    return root


def add_trial(root: Path, subject: int, scene: int, session: int, activity: str, cameras=(1, 3)) -> None:
    place = f"scene{scene}/session{session}"
    for camera in cameras:
        write_video(root / f"video/subject{subject:02d}/cam{camera}/{place}/{activity}.mp4", first=STEP + camera)
    for folder, rate in RATES.items():
        write_sensor(root / folder / f"subject{subject}/{place}/{activity}.csv", sensor_lines(rate, offset=subject))


def convert(source: Path, output: Path | None = None, **options: Any) -> EpisodeStore:
    target = output or source.parent / "out" / "store.h5"
    return EpisodeStore(import_mmact(source, target, **{**SMALL, "overwrite": True, **options}))


def refuse(source: Path, **options: Any) -> str:
    """The one line of an import that fails; nothing is left of it."""
    with pytest.raises(UserError) as caught:
        convert(source, **options)
    message = str(caught.value)
    assert "\n" not in message
    assert not (source.parent / "out" / "store.h5").exists()
    return message
