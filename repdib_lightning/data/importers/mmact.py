"""MMAct: people doing everyday activities, seen by four cameras and felt by a watch and a phone.

MMAct: Kong, Wu, Deng, Klinkigt, Tong, Murakami, MMAct: A large-scale dataset for cross modal human action
understanding, ICCV 2019. Given out on request; the folders are described in ``mmact_trials``.
"""

from __future__ import annotations

import sys
from functools import partial
from pathlib import Path
from typing import Any, Literal

import numpy as np
from tqdm import tqdm

from repdib_lightning.data.importers.mmact_clips import read_clip
from repdib_lightning.data.importers.mmact_notes import Note, NoteLog
from repdib_lightning.data.importers.mmact_plan import Options, Plan, make_plan
from repdib_lightning.data.importers.mmact_report import summary, write_notes
from repdib_lightning.data.importers.mmact_splits import Split
from repdib_lightning.data.importers.mmact_workers import Workers
from repdib_lightning.data.schema import FactorSpec
from repdib_lightning.data.writer import EpisodeWriter
from repdib_lightning.errors import UserError

_LICENCE = "on request from the publisher (mmact19.github.io), not to be passed on"
_AXES = {"orientation": ("azimuth", "pitch", "roll")}


def import_mmact(
    source: Path,
    output: Path,
    *,
    videos: Path | None = None,
    views: str | None = None,
    sensors: str = "acceleration,gyroscope,orientation",
    split: Split = "cross_subject",
    size: int = 64,
    segments: int = 8,
    per_segment: int = 2,
    rate: float = 25,
    seconds: float | None = None,
    cameras_apart: bool = False,
    activities: Literal["mmact", "found"] = "mmact",
    leave_out: str = "",
    strict: bool = False,
    jobs: int = 2,
    environment: str | None = None,
    licence: str | None = None,
    overwrite: bool = False,
    progress: bool = True,
) -> Path:
    """Convert MMAct, or folders of its form, into a store of clips: each trial an episode of one row.

    Observations ``cam1``, ... (T, 3, size, size) uint8 hold ``segments * per_segment`` frames in the middle of as many
    even parts of a video. ``acceleration`` (T, 6: watch, then phone), ``gyroscope`` (T, 3) and ``orientation`` (T, 3)
    float32 begin with the first reading of each file, since videos have no clock; between readings they are linear.
    What is missing, unreadable or beyond the end of a file is zeros, or NaN. Factors: ``activity`` (endogenous),
    ``subject``, ``scene`` and ``session``. What is skipped, and why, is told at the end and written to
    ``OUTPUT.skipped.txt``. An interrupted import goes on with the same command.

    Args:
        source: holds the folders acc_watch_clip, acc_phone_clip, gyro_clip and orientation_clip; where it holds
            gyro_watch_clip or orientation_watch_clip, too, (T, 6) is read: watch, then phone.
        output: the store to write (.h5).
        videos: holds a folder for each subject; by default the folder ``video`` of the source.
        views: cameras, comma-separated, or ``all`` or ``none``; by default cam1,cam3, and all with cameras_apart.
        sensors: observations to read, comma-separated, or ``none``.
        split: what is held out: subjects 17-20, session 5, scene 2 or camera 4; ``none`` leaves that to the reader.
        size: height and width of a frame: the short side is resized to it, then the middle square is kept.
        segments: even parts of a video.
        per_segment: frames of each of them.
        rate: steps a second of the sensors.
        seconds: length of every sequence of readings, longer ones are cut; by default that of the longest.
        cameras_apart: each video is a clip of its own, with the observation ``camera`` and a factor of that name; the
            clips of a trial share its sensors and its number of the recording. cross_view needs it.
        activities: ``mmact``: the 37 classes, two names of files mean others at the desk (scene 3); ``found``: the
            names of the files are the classes.
        leave_out: names of files not to read, without their ending, comma-separated.
        strict: refuse the first file that cannot be used, instead of going without it.
        jobs: processes that read.
        environment: where the data come from, for the record; by default mmact, unknown for activities as found.
        licence: the terms of the data, for the record; by default those of MMAct, unknown for activities as found.
        overwrite: replace an existing output, and begin an interrupted import anew.
        progress: show progress bars on a terminal.

    Returns:
        The output.

    Raises:
        UserError: another layout, an unknown camera, sensor or activity, two files for one place, a split without clips
            to test or train on, and with ``strict`` a file that cannot be used.
    """
    source, output = Path(source), Path(output)
    options = Options(
        source,
        source / "video" if videos is None else Path(videos),
        views or ("all" if cameras_apart else "cam1,cam3"),
        sensors,
        split,
        size,
        segments,
        per_segment,
        rate,
        seconds,
        cameras_apart,
        activities,
        leave_out,
        strict,
    )
    if output.exists() and not overwrite:
        raise UserError(f"{output}: exists already; choose another file or pass --overwrite")
    with Workers(jobs) as workers:
        plan = make_plan(options, workers, progress=progress)
        known = ("mmact", _LICENCE) if activities == "mmact" else ("unknown", "unknown")
        attributes = {
            "environment": environment or known[0],
            "licence": licence or known[1],
            "source": str(source),
            **_describe(options, plan),
        }
        notes = _write(plan, output, attributes, workers, strict=strict, overwrite=overwrite, progress=progress)
    write_notes(output, notes)
    for line in summary(output, plan.clips, plan.evaluation, split, plan.form, notes):
        print(line, file=sys.stderr)
    return output


def _describe(options: Options, plan: Plan) -> dict[str, Any]:
    """Attributes of the store."""
    channels = {
        name: [f"{place} {axis}" for place in folders.values() for axis in _AXES.get(name, "xyz")]
        for name, folders in plan.form.sensors.items()
    }
    return {
        "classes": plan.classes,
        "channels": channels,
        "rate": dict.fromkeys(plan.form.sensors, options.rate),
        "configuration": options.record(),
    }


def _write(
    plan: Plan,
    output: Path,
    attributes: dict[str, Any],
    workers: Workers,
    *,
    strict: bool,
    overwrite: bool,
    progress: bool,
) -> list[Note]:
    """Write the store, or what an interruption left of it to write; returns all notes."""
    classes: dict[str, list[str]] = attributes["classes"]
    apart = plan.clips[0].camera is not None
    writer = EpisodeWriter(
        output,
        rows=len(plan.clips),
        episodes=len(plan.clips),
        observations=plan.form.observations,
        actions=None,
        factors={
            name: FactorSpec("endogenous" if name == "activity" else "exogenous", "categorical", len(names))
            for name, names in classes.items()
        },
        attributes=attributes,
        recordings=apart,
        overwrite=overwrite,
        resume=True,
    )
    with writer, _bar(plan, writer.episodes_done, progress) as bar:
        done = writer.episodes_done
        log = NoteLog(output, done)
        read = workers.map(partial(read_clip, form=plan.form), plan.clips[done:])
        for episode, (observations, notes) in enumerate(read, done):
            for note in notes if strict else ():
                note.check()
            log.add(episode, notes)
            clip = plan.clips[episode]
            values = {"activity": clip.trial.activity, **{name: str(value) for name, value in clip.factors.items()}}
            writer.add_episode(
                observations=observations,
                factors={name: np.array([classes[name].index(value)]) for name, value in values.items()},
                evaluation=plan.evaluation[episode],
                recording=clip.recording if apart else None,
            )
            bar.update()
    log.remove()
    return [*plan.notes, *log.notes]


def _bar(plan: Plan, done: int, progress: bool) -> tqdm:
    return tqdm(total=len(plan.clips), initial=done, desc="import", unit="clip", disable=None if progress else True)
