"""Decides which clips a store of MMAct gets, before the first video is decoded."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any, Literal

from tqdm import tqdm

from repdib_lightning.data.importers.mmact_activities import classed, without
from repdib_lightning.data.importers.mmact_clips import Clip, Form, cut_clips, scan_sensors, unreadable_videos
from repdib_lightning.data.importers.mmact_notes import Note
from repdib_lightning.data.importers.mmact_splits import Split, held_out
from repdib_lightning.data.importers.mmact_trials import Trial, choose_cameras, choose_sensors, find_trials
from repdib_lightning.data.importers.mmact_workers import Workers
from repdib_lightning.errors import UserError


@dataclass(frozen=True)
class Options:
    """What the user chose; ``import_mmact`` says what each of them means.

    Raises:
        UserError: a number that is too small.
    """

    source: Path
    videos: Path
    views: str
    sensors: str
    split: Split
    size: int
    segments: int
    per_segment: int
    rate: float
    seconds: float | None
    cameras_apart: bool
    activities: Literal["mmact", "found"]
    leave_out: str
    strict: bool

    def __post_init__(self) -> None:
        for name in ("size", "segments", "per_segment"):
            if getattr(self, name) < 1:
                raise UserError(f"--{name} must be at least 1, is {getattr(self, name)}")
        for name in ("rate", "seconds"):
            value = getattr(self, name)
            if value is not None and not 0 < value <= 1000:
                raise UserError(f"--{name} must be above 0 and at most 1000, is {value}")

    def record(self) -> dict[str, Any]:
        """The options as plain values, for the store."""
        plain = asdict(self)
        del plain["source"], plain["strict"]
        return {**plain, "videos": str(self.videos)}


@dataclass(frozen=True)
class Plan:
    """What is known of a store before its first clip is written.

    Attributes:
        clips: in the order of the episodes.
        evaluation: which of them are held out.
        activities: names of the classes.
        form: the arrays of every clip.
        notes: on folders, sensors and trials that are left out.
    """

    clips: list[Clip]
    evaluation: list[bool]
    activities: list[str]
    form: Form
    notes: list[Note]

    @property
    def classes(self) -> dict[str, list[str]]:
        """Factor -> names of its values: every activity, and the numbers of subjects, scenes, ... that occur."""
        numbers = {name: sorted({clip.factors[name] for clip in self.clips}) for name in self.clips[0].factors}
        return {"activity": self.activities, **{name: list(map(str, found)) for name, found in numbers.items()}}


def make_plan(options: Options, workers: Workers, *, progress: bool) -> Plan:
    """Find the trials and read their sensors; of clips without sensors, look at a frame of the videos.

    Raises:
        UserError: as ``import_mmact`` says.
    """
    if not options.source.is_dir():
        raise UserError(f"{options.source}: {'is a file' if options.source.exists() else 'no such folder'}")
    sensors = choose_sensors(options.source, options.sensors)
    cameras = choose_cameras(options.videos, options.views)
    if not cameras and (not sensors or options.cameras_apart):
        raise UserError(
            "--views none: " + ("no camera to take apart" if sensors else "nothing to read, with no sensors")
        )
    folders = [folder for streams in sensors.values() for folder in streams]
    found = find_trials(options.source, options.videos if cameras else None, folders)
    if not found.trials:
        raise UserError(f"{options.source}: holds no video and no sensor file in folders subjectN/.../sceneN/sessionN")
    trials, activities = classed(without(found.trials, options.leave_out), options.activities)
    clips, left_out = cut_clips(trials, cameras, apart=options.cameras_apart)
    held_out(clips, options.split)
    notes = _Notes([*found.notes, *left_out], options.strict)
    steps = _scan(trials, options.rate, notes, workers, progress)
    clips = _readable(clips, steps, notes, workers)
    views = ("camera",) if options.cameras_apart else tuple(f"cam{camera}" for camera in cameras)
    longest = max(steps) if options.seconds is None else max(1, round(options.seconds * options.rate))
    if not longest and sensors:
        raise UserError(f"{options.source}: not one sensor file is readable, the first {notes.lines[0]}; see --sensors")
    form = Form(views, sensors, options.size, options.segments * options.per_segment, options.rate, longest)
    return Plan(clips, held_out(clips, options.split), activities, form, notes.lines)


class _Notes:
    """Notes so far; the first one on a file that cannot be used is an error where nothing may be skipped."""

    def __init__(self, lines: Iterable[Note], strict: bool) -> None:
        self.lines: list[Note] = []
        self._strict = strict
        self.add(lines)

    def add(self, lines: Iterable[Note]) -> None:
        for line in lines:
            if self._strict:
                line.check()
            self.lines.append(line)


def _scan(trials: Sequence[Trial], rate: float, notes: _Notes, workers: Workers, progress: bool) -> list[int]:
    """Steps of the longest readable sensor of each trial."""
    steps = []
    bar = tqdm(total=len(trials), desc="check", unit="trial", disable=None if progress else True)
    with bar:
        for scan in workers.map(partial(scan_sensors, rate=rate), trials):
            notes.add(scan.notes)
            steps.append(scan.steps)
            bar.update()
    return steps


def _readable(clips: Sequence[Clip], steps: Sequence[int], notes: _Notes, workers: Workers) -> list[Clip]:
    """The clips of which a sensor or a video can be read."""
    doubtful = [clip for clip in clips if not steps[clip.recording]]
    lost: set[int] = set()
    for clip, wrong in zip(doubtful, workers.map(unreadable_videos, doubtful), strict=True):
        if wrong is not None:
            notes.add([*wrong, Note("left out", str(clip), "nothing of it can be read")])
            lost.add(id(clip))
    readable = [clip for clip in clips if id(clip) not in lost]
    if not readable:
        raise UserError(f"nothing can be read: {notes.lines[0]}")
    return readable
