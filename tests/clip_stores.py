"""Small stores of clips: people doing things before two cameras, with sensors on wrist and hip; one clip is one row."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from repdib_lightning.data.schema import FactorSpec
from repdib_lightning.data.writer import EpisodeWriter
from repdib_lightning.records import ArraySpec

ACTIVITIES = ("waving", "walking", "sitting", "jumping", "falling", "drinking")
VIEWS, SENSORS = ("cam1", "cam2"), ("acceleration", "gyroscope", "orientation")
MODALITIES = (*VIEWS, *SENSORS)


def write_clips(
    path: Path,
    *,
    clips: int = 48,
    subjects: int = 4,
    activities: int = 3,
    sessions: int = 2,
    size: int = 16,
    frames: int = 4,
    steps: int = 20,
    missing: bool = True,
    per_recording: int = 1,
    evaluation: Sequence[str] = (),
    seed: int = 0,
    **options: Any,
) -> Path:
    """A store whose every modality tells the activity, and tells the subject as well.

    Clip n shows activity n modulo ``activities``, then the next subject, then the next session. With ``missing``, each
    fifth clip lacks a modality (all in turn), each fourth ends after 3/4 of its frames and steps, and each sixth has
    no readings of the second device. Subjects are named from "1" on, sessions too.

    Args:
        path: the file to make.
        clips, subjects, activities, sessions: how many.
        size, frames, steps: H and W, T of the videos, T of the sensors.
        missing: whether anything is.
        per_recording: consecutive clips that are cut of one recording (same activity, subject, session); where it is 1
            the store holds no recordings.
        evaluation: names of subjects whose clips are marked for evaluation.
        seed: of the noise.
        options: of the writer.
    """
    random = np.random.default_rng(seed)
    counts = {"activity": activities, "subject": subjects, "session": sessions}
    names = {"activity": list(ACTIVITIES[:activities])}
    names |= {name: [str(1 + number) for number in range(counts[name])] for name in ("subject", "session")}
    if per_recording > 1:
        options["recordings"] = True
    observations = {view: ArraySpec((frames, 3, size, size)) for view in VIEWS}
    observations |= {sensor: ArraySpec((steps, 6), "float32") for sensor in SENSORS}
    factors = {
        name: FactorSpec("endogenous" if name == "activity" else "exogenous", "categorical", count)
        for name, count in counts.items()
    }
    attributes = {"classes": names, **options.pop("attributes", {})}
    with EpisodeWriter(
        path,
        rows=clips,
        episodes=clips,
        observations=observations,
        actions=None,
        factors=factors,
        attributes=attributes,
        **options,
    ) as writer:
        for clip in range(clips):
            recording = clip // per_recording
            person, activity = divmod(recording, activities)
            levels = {
                "activity": activity,
                "subject": person % subjects,
                "session": person // subjects % sessions,
            }
            shown: dict[str, np.ndarray] = {
                view: film(random, activity, levels["subject"], frames, size) for view in VIEWS
            }
            shown |= {
                sensor: readings(random, activity, levels["subject"], steps, 10.0 ** (place - 1))
                for place, sensor in enumerate(SENSORS)
            }
            if missing:
                take_away(shown, clip)
            writer.add_episode(
                observations={name: array[None] for name, array in shown.items()},
                factors={name: np.array([level]) for name, level in levels.items()},
                evaluation=names["subject"][levels["subject"]] in evaluation,
                **({"recording": recording} if per_recording > 1 else {}),
            )
    return path


def film(random: np.random.Generator, activity: int, subject: int, frames: int, size: int) -> np.ndarray:
    """A bright bar whose row tells the activity and that moves to the right, before a wall as grey as the subject.

    (T, C, H, W) uint8.
    """
    pictures = random.integers(1, 30, (frames, 3, size, size)) + 10 * (subject % 8)
    height = max(1, size // len(ACTIVITIES))
    top = activity * height
    for step in range(frames):
        left = step * size // (2 * frames)
        pictures[step, :, top : top + height, left : left + size // 2] = 220
    return pictures.astype(np.uint8)


def readings(random: np.random.Generator, activity: int, subject: int, steps: int, scale: float) -> np.ndarray:
    """Oscillations as fast as the activity number tells around a resting value: (T, 6) float32."""
    time = np.arange(steps)[:, None] / steps
    phase = random.random() + np.arange(6)
    wave = np.sin(2 * np.pi * (time * (1 + 2 * activity) + phase)) * (1.0 + 0.1 * subject)
    resting = activity - 1.0 + 0.2 * np.arange(6)
    return ((wave + resting + 0.1 * random.normal(size=(steps, 6))) * scale).astype(np.float32)


def take_away(shown: dict[str, np.ndarray], clip: int) -> None:
    """Leave out what the clip of this number lacks, in place."""
    if clip % 4 == 1:
        for array in shown.values():
            array[3 * len(array) // 4 :] = nothing(array)
    if clip % 6 == 2:
        for sensor in SENSORS:
            shown[sensor][:, 3:] = np.nan
    if clip % 5 == 3:
        lacking = shown[MODALITIES[clip // 5 % len(MODALITIES)]]
        lacking[:] = nothing(lacking)


def nothing(array: np.ndarray) -> float:
    """What is stored where nothing was observed."""
    return 0 if array.dtype == np.uint8 else np.nan
