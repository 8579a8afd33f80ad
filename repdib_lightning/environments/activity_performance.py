"""One performance of an activity: how the body moves through it, moment by moment, and what the devices read."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from repdib_lightning.environments.activity_body import SIDES, Body
from repdib_lightning.environments.activity_motions import SCRIPTS, Manner, perform
from repdib_lightning.environments.activity_people import Person
from repdib_lightning.environments.activity_sensors import readings

RATE = 100
"""Moments a second at which bodies are posed and devices read."""

STOOL = 0.36
"""Metres from the feet of who stands in its place to the stool behind, at a height of 1.72 m."""

_MARGIN = 10  # moments at both ends, for differences and smoothing
_SMOOTHING = {"height": 0.02, "speed": 0.06}  # seconds
_GRIP = 0.01  # metres: of two feet, one that is so much higher hardly holds the body
_ANKLES = (-50.0, 40.0)


@dataclass(frozen=True)
class Performance:
    """What happens over the n moments of a clip.

    Attributes:
        activity: its name.
        person, manner: who does it, and how.
        started: seconds of the activity that had passed when the clip begins.
        qpos: (n, nq) of the body.
        stool: (2,) where the stool stands.
        readings: sensor -> (n, 2, 3) of watch and phone, without noise.
    """

    activity: str
    person: Person
    manner: Manner
    started: float
    qpos: np.ndarray
    stool: np.ndarray
    readings: dict[str, np.ndarray]

    def __len__(self) -> int:
        return len(self.qpos)


def rehearse(
    body: Body,
    activity: str,
    person: Person,
    manner: Manner,
    span: tuple[float, float] = (0.0, 1.0),
    facing: float = 0.0,
    place: tuple[float, float] = (0.0, 0.0),
) -> Performance:
    """Pose a body through an activity.

    The feet decide where the body is: the foot that is on the floor stays where it is, and the lowest part of the body
    touches the floor unless it leaps.

    Args:
        body: of the person.
        activity: its name.
        person, manner: who does it, and how.
        span: share of the activity at which the clip begins, and at which it ends.
        facing: degrees to the left of +x.
        place: x and y of the middle of where the person goes.
    """
    script = SCRIPTS[activity]
    started, ended = (share * script.seconds / manner.tempo for share in span)
    count = int((ended - started) * RATE)
    seconds = started + np.arange(-_MARGIN, count + _MARGIN) / RATE
    angles, flight = perform(script, manner, seconds)
    angles["spin"] = angles["spin"] + facing
    for side in SIDES:
        level = angles[f"{side}_knee"] - angles[f"{side}_hip"] + angles["tip"]
        angles[f"{side}_ankle"] = np.clip(level, *_ANKLES)
    qpos = np.zeros((len(seconds), body.model.nq))
    for joint, degrees in angles.items():
        qpos[:, body.columns[joint]] = np.radians(degrees)
    track = body.track(qpos, person.sites)
    moved = np.concatenate([_steps(track.feet), _smooth(flight - track.lowest, "height")[:, None]], axis=1)
    moved[:, :2] += place - moved[_MARGIN:-_MARGIN, :2].mean(axis=0)
    qpos[:, [body.columns[name] for name in "xyz"]] = moved
    inside = slice(_MARGIN - 1, count + _MARGIN + 1)
    places, turns = track.places[inside] + moved[inside, None], track.turns[inside] @ person.mounts
    clip = slice(_MARGIN, count + _MARGIN)
    stool = _stool(activity, track.feet[clip] + moved[clip, None], np.radians(facing), person)
    return Performance(activity, person, manner, started, qpos[clip], stool, readings(places, turns, RATE))


def _steps(feet: np.ndarray) -> np.ndarray:
    """(n, 2) where the body is, from (n, 2, 3) where its feet are beneath it."""
    higher = feet[..., 2] - feet[..., 2].min(axis=1, keepdims=True)
    weight = np.exp(-higher / _GRIP)
    weight /= weight.sum(axis=1, keepdims=True)
    both = (weight[1:] + weight[:-1]) / 2
    speed = -(both[..., None] * np.diff(feet[..., :2], axis=0)).sum(axis=1)
    return np.concatenate([np.zeros((1, 2)), np.cumsum(_smooth(speed, "speed"), axis=0)])


def _smooth(values: np.ndarray, what: str) -> np.ndarray:
    """Along the first axis, by a Gaussian window."""
    width = _SMOOTHING[what] * RATE
    reach = int(3 * width)
    window = np.exp(-0.5 * (np.arange(-reach, reach + 1) / width) ** 2)
    padded = np.pad(values, [(reach, reach)] + [(0, 0)] * (values.ndim - 1), mode="edge")
    seen = np.lib.stride_tricks.sliding_window_view(padded, 2 * reach + 1, axis=0)
    return seen @ (window / window.sum())


def _stool(activity: str, feet: np.ndarray, facing: float, person: Person) -> np.ndarray:
    """Behind who stays in its place, and in the middle of the way of who goes round."""
    if SCRIPTS[activity].turning:
        return feet[..., :2].mean(axis=(0, 1))
    behind = STOOL * person.figure.height / 1.72 * person.figure.legs
    return feet[0, :, :2].mean(axis=0) - behind * np.array([np.cos(facing), np.sin(facing)])
