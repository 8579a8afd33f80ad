"""Readings of a device that moves with a body: accelerometer, gyroscope and orientation, from its poses.

A device's x, y and z axes are columns of its rotation, against a world whose x points east, y north and z up.
Orientation is as Android has it: azimuth of the device's y axis from north to the east, pitch about x, roll about y.
"""

from __future__ import annotations

import numpy as np

from repdib_lightning.environments.activity_motions import GRAVITY

SENSORS = {"acceleration": ("x", "y", "z"), "gyroscope": ("x", "y", "z"), "orientation": ("azimuth", "pitch", "roll")}
"""Sensor -> its channels on each device; in m/s^2 with gravity, rad/s and degrees."""

DEVICES = ("watch", "phone")

_WHITE = {"acceleration": 0.25, "gyroscope": 0.05, "orientation": 1.5}
_BIAS = {"acceleration": 0.3, "gyroscope": 0.04, "orientation": 5.0}
_DRIFT = {"acceleration": 0.08, "gyroscope": 0.015, "orientation": 1.0}
"""Standard deviations: of each reading, of what is added throughout, and of what is added to that in a second."""

_RANGE = {"acceleration": 16 * GRAVITY, "gyroscope": float(np.radians(2000)), "orientation": np.inf}
"""Largest reading of a device."""


def readings(places: np.ndarray, turns: np.ndarray, rate: float) -> dict[str, np.ndarray]:
    """What an ideal device reads.

    Args:
        places: (n + 2, ..., 3) metres, with a moment before and one after those that are wanted.
        turns: (n + 2, ..., 3, 3) its axes, as columns.
        rate: moments a second.

    Returns:
        Sensor -> (n, ..., 3).
    """
    axes = turns[1:-1]
    moved = (places[2:] - 2 * places[1:-1] + places[:-2]) * rate**2 + [0.0, 0.0, GRAVITY]
    turned = np.swapaxes(turns[:-2], -1, -2) @ turns[2:]
    return {
        "acceleration": np.einsum("...ji,...j->...i", axes, moved),
        "gyroscope": _rotation_vector(turned) * rate / 2,
        "orientation": _orientation(axes),
    }


def with_noise(clean: dict[str, np.ndarray], rate: float, random: np.random.Generator) -> dict[str, np.ndarray]:
    """Readings, (n, D, 3), of a device that adds noise, a bias and its slow random walk, and has a largest reading."""
    noisy = {}
    for name, values in clean.items():
        walk = np.cumsum(random.normal(0, _DRIFT[name] / np.sqrt(rate), values.shape), axis=0)
        bias = random.normal(0, _BIAS[name], values.shape[1:])
        noise = random.normal(0, _WHITE[name], values.shape)
        noisy[name] = np.clip(values + noise + bias + walk, -_RANGE[name], _RANGE[name])
    angles = noisy["orientation"]
    noisy["orientation"] = np.concatenate([_wrapped(angles[..., :1]), angles[..., 1:2], _wrapped(angles[..., 2:])], -1)
    return noisy


def slower(values: np.ndarray, every: int, sensor: str) -> np.ndarray:
    """(n // every, ...) of (n, ...): means, but of angles, which may turn over, the first of each."""
    whole = values[: len(values) // every * every]
    parts = whole.reshape(-1, every, *values.shape[1:])
    return parts[:, 0] if sensor == "orientation" else parts.mean(axis=1)


def _rotation_vector(turned: np.ndarray) -> np.ndarray:
    """(..., 3) axis times angle of (..., 3, 3), for turns well below half a circle."""
    twice_sine = np.stack(
        [
            turned[..., 2, 1] - turned[..., 1, 2],
            turned[..., 0, 2] - turned[..., 2, 0],
            turned[..., 1, 0] - turned[..., 0, 1],
        ],
        axis=-1,
    )
    sine = np.linalg.norm(twice_sine, axis=-1, keepdims=True) / 2
    cosine = (np.trace(turned, axis1=-2, axis2=-1)[..., None] - 1) / 2
    angle = np.arctan2(sine, cosine)
    return twice_sine / 2 * np.where(sine > 1e-9, angle / np.maximum(sine, 1e-9), 1.0)


def _orientation(axes: np.ndarray) -> np.ndarray:
    """(..., 3) azimuth in [-180, 180), pitch and roll in degrees."""
    azimuth = np.arctan2(axes[..., 0, 1], axes[..., 1, 1])
    pitch = np.arcsin(np.clip(-axes[..., 2, 1], -1, 1))
    roll = np.arctan2(-axes[..., 2, 0], axes[..., 2, 2])
    return np.degrees(np.stack([azimuth, pitch, roll], axis=-1))


def _wrapped(degrees: np.ndarray) -> np.ndarray:
    return (degrees + 180) % 360 - 180
