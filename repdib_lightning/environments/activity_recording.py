"""A recording of simulated people: which clips there are, and how one of them is made."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property, lru_cache, partial
from typing import Any

import numpy as np

from repdib_lightning.environments.activity_body import CAMERAS, Body
from repdib_lightning.environments.activity_motions import SCRIPTS
from repdib_lightning.environments.activity_people import manner, person, session
from repdib_lightning.environments.activity_performance import RATE, Performance, rehearse
from repdib_lightning.environments.activity_sensors import DEVICES, SENSORS, slower, with_noise
from repdib_lightning.environments.activity_stage import Pillar, Stage
from repdib_lightning.errors import UserError, nearest

STORED_RATE = 25
SECONDS = 4.0
"""Readings a second in a store, and of the longest clip."""

STEPS = int(STORED_RATE * SECONDS)
HELD_OUT = 5  # one in so many people is held out

_CLIP, _PLAN = 6, 7  # random streams beside those of people
_SHORT, _OCCLUDED = 0.12, 0.15
_MISSING, _DEVICE_MISSING = 0.03, 0.02


@dataclass(frozen=True)
class Trial:
    """What a clip shows, by number.

    Attributes:
        subject, session, activity: from 0.
    """

    subject: int
    session: int
    activity: int


@dataclass(frozen=True)
class Clip:
    """A clip before it is written.

    Attributes:
        trial: what it shows.
        left_handed: the subject's main hand.
        performance: how the body moves.
        readings: sensor -> (n, 2, 3) of watch and phone at 100 Hz; NaN where a device's are missing.
        film: a function from moments, (frames,) int64, to camera -> (frames, 3, H, W) uint8; without missing cameras.
    """

    trial: Trial
    left_handed: bool
    performance: Performance
    readings: dict[str, np.ndarray]
    film: Callable[[np.ndarray], dict[str, np.ndarray]]


@dataclass(frozen=True)
class ActivityRecording:
    """What a recording is made of; together with the renderer it decides every byte.

    Attributes:
        clips: how many.
        subjects, sessions: how many people, and visits of each.
        activities: names.
        size: height and width of the pictures in pixels.
        frames: of each view of a clip.
        seed: of everything.
    """

    clips: int
    subjects: int
    sessions: int
    activities: tuple[str, ...]
    size: int
    frames: int
    seed: int

    def __post_init__(self) -> None:
        bounds = {"clips": (1, 10**6), "subjects": (1, 1000), "sessions": (1, 100), "frames": (1, 200)}
        for name, (least, most) in {**bounds, "size": (16, 512), "seed": (0, 2**63 - 1)}.items():
            if not least <= getattr(self, name) <= most:
                raise UserError(f"{name}={getattr(self, name)}: must be in {least} to {most}")
        for name in self.activities:
            if name not in SCRIPTS:
                raise UserError(f"activities: unknown activity '{name}', {nearest(name, SCRIPTS)}")
        if len(set(self.activities)) < len(self.activities) or len(self.activities) < 2:
            raise UserError(f"activities={list(self.activities)}: must be at least 2, each named once")

    @property
    def trials(self) -> int:
        """How many combinations of subject, session and activity there are."""
        return self.subjects * self.sessions * len(self.activities)

    @cached_property
    def plan(self) -> list[Trial]:
        """What every clip shows: all combinations equally often, as nearly as the number of clips has it, shuffled."""
        return balanced_plan(self.clips, self.subjects, self.sessions, len(self.activities), self.seed)

    def held_out(self, trial: Trial) -> bool:
        """Whether a clip is of the last fifth of the people."""
        return trial.subject >= self.subjects - max(self.subjects // HELD_OUT, int(self.subjects > 1))

    def open(self) -> Callable[[int], dict[str, Any]]:
        """Open the stage in this process: a function that records a clip for a store."""
        return partial(stored_clip, self, Studio(self))


class Studio:
    """The stage of this process, and the bodies of the people that were on it."""

    def __init__(self, recording: ActivityRecording) -> None:
        self._recording = recording
        self.body = lru_cache(maxsize=64)(self._body)
        self.stage = Stage(self.body(0), recording.size)

    def _body(self, subject: int) -> Body:
        return Body(person(self._recording.seed, subject).figure, self._recording.size)

    def clip(self, number: int) -> Clip:
        """Rehearse a clip, read its sensors, and lose some of it; it depends on the seed and its number alone."""
        seed, trial = self._recording.seed, self._recording.plan[number]
        moves, noise, loss = (np.random.default_rng([seed, _CLIP, number, part]) for part in range(3))
        who, body = person(seed, trial.subject), self.body(trial.subject)
        name = self._recording.activities[trial.activity]
        how = manner(seed, trial.subject, list(SCRIPTS).index(name), who, SCRIPTS[name], moves)
        longest = min(1.0, SECONDS * how.tempo / SCRIPTS[name].seconds)
        facing, place = moves.uniform(10, 80), tuple(moves.normal(0, 0.1, 2))
        played = rehearse(body, name, who, how, _span(moves, longest), facing, place)
        cameras, present = _losses(loss)
        film = partial(
            self.stage.film,
            body,
            played,
            session(seed, trial.session, trial.subject),
            cameras=cameras,
            pillars=_pillars(loss),
        )
        readings = {
            sensor: np.where(present[sensor][:, None], values, np.nan)
            for sensor, values in with_noise(played.readings, RATE, noise).items()
        }
        return Clip(trial, who.left_handed, played, readings, film)


def stored_clip(recording: ActivityRecording, studio: Studio, number: int) -> dict[str, Any]:
    """Record one clip: the arguments of :meth:`EpisodeWriter.add_episode`."""
    clip = studio.clip(number)
    moments = ((np.arange(recording.frames) + 0.5) * len(clip.performance) / recording.frames).astype(np.int64)
    shape = (1, recording.frames, 3, recording.size, recording.size)
    observations: dict[str, np.ndarray] = {name: np.zeros(shape, np.uint8) for name in CAMERAS}
    for name, frames in clip.film(moments).items():
        observations[name][0] = frames
        observations[name][0, ~frames.any(axis=(1, 2, 3)), 0, 0, 0] = 1  # zeros only would mean that it is missing
    for sensor in SENSORS:
        readings = slower(clip.readings[sensor], RATE // STORED_RATE, sensor)[:STEPS]
        observations[sensor] = np.full((1, STEPS, 2 * 3), np.nan, np.float32)
        observations[sensor][0, : len(readings)] = readings.reshape(len(readings), -1)
    trial = clip.trial
    factors = {
        "activity": trial.activity,
        "subject": trial.subject,
        "session": trial.session,
        "handedness": int(clip.left_handed),
    }
    return {
        "observations": observations,
        "factors": {name: np.array([value]) for name, value in factors.items()},
        "evaluation": recording.held_out(trial),
    }


def balanced_plan(clips: int, subjects: int, sessions: int, activities: int, seed: int) -> list[Trial]:
    """Combinations for a number of clips, in random order.

    Every combination comes equally often, or once more; every subject and every activity does, too, as nearly as can
    be, and so do pairs of them.
    """
    random = np.random.default_rng([seed, _PLAN])
    combinations = subjects * sessions * activities
    chosen: list[Trial] = []
    for begun in range(0, clips, combinations):
        names = [random.permutation(count) for count in (subjects, sessions, activities)]
        place = np.arange(min(combinations, clips - begun))
        diagonal, pair = place // np.lcm(subjects, activities), place // (subjects * activities)
        subject, activity = (place + diagonal) % subjects, place % activities
        visit = (pair + subject + activity) % sessions
        drawn = zip(names[0][subject], names[1][visit], names[2][activity], strict=True)
        chosen += [Trial(*map(int, numbers)) for numbers in drawn]
    return [chosen[number] for number in random.permutation(clips)]


def _span(random: np.random.Generator, longest: float) -> tuple[float, float]:
    """Share of the activity at which a clip begins and ends; some clips miss its beginning or its end."""
    length = longest * (random.uniform(0.55, 0.8) if random.random() < _SHORT else 1.0)
    begin = random.choice([0.0, longest - length])
    return float(begin), float(begin + length)


def _pillars(random: np.random.Generator) -> tuple[Pillar, ...]:
    """What stands before each camera."""
    pillars = []
    for camera in CAMERAS:
        begin, length = random.uniform(0, 0.6), random.uniform(0.2, 0.5)
        aside, width, shade = random.uniform(-0.35, 0.35), random.uniform(0.5, 1.0), random.uniform(0.1, 0.8)
        if random.random() < _OCCLUDED:
            pillars.append(Pillar(camera, (begin, begin + length), aside, width, shade))
    return tuple(pillars)


def _losses(random: np.random.Generator) -> tuple[tuple[str, ...], dict[str, np.ndarray]]:
    """Cameras that worked, and sensor -> (2,) bool: the devices on which it did; something always did."""
    cameras = tuple(name for name in CAMERAS if random.random() >= _MISSING)
    devices = random.random(len(DEVICES)) >= _DEVICE_MISSING
    present = {}
    for sensor in SENSORS:
        works = random.random() >= _MISSING
        present[sensor] = devices & (random.random(len(DEVICES)) >= _DEVICE_MISSING) & works
    if not cameras and not any(map(np.any, present.values())):
        cameras = CAMERAS
    return cameras, present
