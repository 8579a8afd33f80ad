"""Who performs an activity, how, and how a session looks; all of it drawn from the seed and a number."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from repdib_lightning.environments.activity_body import SIDES, Figure
from repdib_lightning.environments.activity_motions import ANGLES, Manner, Script

_PERSON, _SESSION, _STYLE, _VISIT, _SPREAD = range(1, 6)
"""What random streams are for."""

_LEFT_HANDED, _WATCH_ON_MAIN, _WATCH_INSIDE, _PHONE_LEFT, _PHONE_TURNED = 5, 3, 4, 2, 3
"""One person in so many is, or wears it so; spread evenly over their numbers, so that no part has all or none."""


@dataclass(frozen=True)
class Person:
    """What stays the same of a subject.

    Attributes:
        figure: proportions.
        tempo, amplitude: of all that it does; 1 is average.
        idle: degrees that it sways by.
        posture: angle -> degrees, how it holds itself.
        left_handed: its main hand is the left one.
        sites: where it wears watch and phone.
        mounts: (2, 3, 3) rotation of watch and phone against the limb.
        colours: part of the body (``skin``, ``hair``, ``shirt``, ``trousers``, ``shoes``) -> rgb.
    """

    figure: Figure
    tempo: float
    amplitude: float
    idle: float
    posture: dict[str, float]
    left_handed: bool
    sites: tuple[str, str]
    mounts: np.ndarray
    colours: dict[str, np.ndarray]

    @property
    def watch_on_the_right(self) -> bool:
        """Whether the watch is worn on the right wrist."""
        return self.sites[0].startswith("right")


@dataclass(frozen=True)
class Session:
    """What a session looks like.

    Attributes:
        floor, wall, stool: rgb.
        tiled: whether the floor shows tiles.
        lamp: (3,) where its light goes.
        brightness: of the lamp.
        direction, elevation, distance, view: of the cameras, in degrees and metres; the second one stands opposite.
    """

    floor: np.ndarray
    wall: np.ndarray
    stool: np.ndarray
    tiled: bool
    lamp: np.ndarray
    brightness: float
    direction: float
    elevation: float
    distance: float
    view: float


def person(seed: int, number: int) -> Person:
    """The subject of a number from 0."""
    random = np.random.default_rng([seed, _PERSON, number])
    left_handed = _one_in(_LEFT_HANDED, seed, 0, number)
    watch_left = left_handed == _one_in(_WATCH_ON_MAIN, seed, 1, number)
    phone_left = _one_in(_PHONE_LEFT, seed, 2, number)
    turned = [_one_in(_WATCH_INSIDE, seed, 3, number), _one_in(_PHONE_TURNED, seed, 4, number)]
    loose = random.normal(0, 14, (2, 3))
    mounts = [_rotation(angles + np.array([180 * turn, 0, 0])) for angles, turn in zip(loose, turned, strict=True)]
    posture = {name: random.normal(0, 4) for name in ("bend", "nod", "main_raise", "other_raise")}
    posture |= {name: abs(random.normal(0, 12)) for name in ("main_elbow", "other_elbow")}
    posture |= {name: 4 + abs(random.normal(0, 5)) for name in ("main_spread", "other_spread")}
    return Person(
        Figure(random.uniform(1.52, 1.92), random.uniform(0.85, 1.2), *random.uniform(0.93, 1.07, 2)),
        tempo=float(np.exp(random.uniform(-0.25, 0.25))),
        amplitude=random.uniform(0.78, 1.12),
        idle=random.uniform(0.4, 2.2),
        posture=posture,
        left_handed=left_handed,
        sites=(f"{SIDES[not watch_left]}_watch", f"{SIDES[not phone_left]}_phone"),
        mounts=np.stack(mounts),
        colours=_clothes(random),
    )


def session(seed: int, number: int, subject: int) -> Session:
    """The session of a number from 0; for each subject the cameras stand a little different."""
    look = np.random.default_rng([seed, _SESSION, number])
    visit = np.random.default_rng([seed, _VISIT, number, subject])
    azimuth = look.uniform(0, 2 * np.pi)
    return Session(
        floor=_colour(look, 0.15, (0.35, 0.8)),
        wall=_colour(look, 0.2, (0.4, 0.9)),
        stool=_colour(look, 0.6, (0.2, 0.8)),
        tiled=bool(look.random() < 0.6),
        lamp=np.array([0.7 * np.cos(azimuth), 0.7 * np.sin(azimuth), -1.0]),
        brightness=look.uniform(0.35, 0.8),
        direction=look.normal(0, 7) + visit.normal(0, 2),
        elevation=look.uniform(7, 20) + visit.normal(0, 1),
        distance=look.uniform(4.0, 4.7) + visit.normal(0, 0.1),
        view=look.uniform(32, 36),
    )


def manner(seed: int, subject: int, activity: int, who: Person, script: Script, clip: np.random.Generator) -> Manner:
    """How a person does an activity: partly as always, partly as it happens in this clip."""
    habit = np.random.default_rng([seed, _STYLE, subject, activity])
    names = sorted({_joint(name) for name in ANGLES})
    always = dict(zip(names, habit.normal(0, 0.13, len(names)), strict=True))
    now = clip.normal(0, 0.05, len(ANGLES))
    scales = {name: float(np.exp(always[_joint(name)] + here)) for name, here in zip(ANGLES, now, strict=True)}
    tempo = who.tempo * float(np.exp(habit.normal(0, 0.08) + clip.normal(0, 0.05)))
    return Manner(
        tempo=tempo,
        amplitude=who.amplitude,
        delay=float(np.clip(habit.normal(0, 0.03) + clip.normal(0, 0.03), -0.1, 0.1)),
        scales=scales,
        offsets={name: degrees + clip.normal(0, 2) for name, degrees in who.posture.items()},
        ahead=clip.uniform(0, 10),
        idle=who.idle,
        turning=float(clip.choice([-1, 1]) * clip.uniform(0.85, 1.15) * tempo * script.turning),
        left_handed=who.watch_on_the_right if script.watch else who.left_handed,
    )


def _joint(name: str) -> str:
    """What is scaled alike: both legs, but each arm by itself."""
    return name.rpartition("_")[2] if name.endswith(("hip", "splay", "knee", "ankle")) else name


def _one_in(count: int, seed: int, trait: int, number: int) -> bool:
    """Whether a person has a trait that one in so many has: in every round of ``count`` people exactly one."""
    random = np.random.default_rng([seed, _SPREAD, trait, number // count])
    return bool(number % count == random.integers(count))


def _rotation(degrees: np.ndarray) -> np.ndarray:
    """(3, 3) about x, then y, then z."""
    (a, b, c), (d, e, f) = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    about_x = np.array([[1, 0, 0], [0, a, -d], [0, d, a]])
    about_y = np.array([[b, 0, e], [0, 1, 0], [-e, 0, b]])
    about_z = np.array([[c, -f, 0], [f, c, 0], [0, 0, 1]])
    return about_z @ about_y @ about_x


def _clothes(random: np.random.Generator) -> dict[str, np.ndarray]:
    tone = random.uniform(0.4, 0.95)
    return {
        "skin": tone * np.array([1.0, 0.8, 0.68]),
        "hair": random.uniform(0.05, 0.6) * np.array([1.0, 0.8, 0.55]),
        "shirt": _colour(random, 0.8, (0.3, 0.95)),
        "trousers": _colour(random, 0.5, (0.12, 0.6)),
        "shoes": _colour(random, 0.3, (0.08, 0.5)),
    }


def _colour(random: np.random.Generator, saturation: float, brightness: tuple[float, float]) -> np.ndarray:
    """(3,) rgb of any hue."""
    hue, vivid, bright = random.uniform(0, 1), random.uniform(0, saturation), random.uniform(*brightness)
    around = np.abs((6 * hue + np.array([0, 4, 2])) % 6 - 3)
    return bright * (1 - vivid * (1 - np.clip(around - 1, 0, 1)))
