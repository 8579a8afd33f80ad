"""Readings of simulated devices against what physics says."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from repdib_lightning.environments.activity_sensors import readings, slower, with_noise

RATE = 100


def still(turn: np.ndarray, count: int = 5) -> dict[str, np.ndarray]:
    """Readings of a device that does not move: (count, 3)."""
    return readings(np.zeros((count + 2, 3)), np.broadcast_to(turn, (count + 2, 3, 3)), RATE)


def turning(count: int, seed: int) -> Rotation:
    """A slow, smooth tumble."""
    random = np.random.default_rng(seed)
    seconds = np.arange(count)[:, None] / RATE
    angles = sum(a * np.sin(2 * np.pi * (f * seconds + p)) for a, f, p in random.uniform(0.1, 1.0, (3, 3, 3)))
    return Rotation.from_euler("xyz", angles)


@pytest.mark.parametrize("axis", range(3))
@pytest.mark.parametrize("sign", [1, -1])
def test_at_rest_the_axis_that_points_up_reads_gravity(axis, sign):
    columns = np.roll(np.eye(3), axis - 2, axis=1) * sign
    if sign < 0:
        columns[:, (axis + 1) % 3] *= -1
    assert np.isclose(np.linalg.det(columns), 1)
    read = still(columns)
    assert np.allclose(read["acceleration"], sign * 9.81 * np.eye(3)[axis])
    assert np.allclose(read["gyroscope"], 0)


def test_at_rest_any_device_reads_gravity_in_all():
    turns = Rotation.random(20, rng=0).as_matrix()
    read = readings(np.zeros((7, 20, 3)), np.broadcast_to(turns, (7, 20, 3, 3)), RATE)
    assert read["acceleration"].shape == (5, 20, 3)
    assert np.allclose(np.linalg.norm(read["acceleration"], axis=-1), 9.81)
    assert np.allclose(np.einsum("dij,ndj->ndi", turns, read["acceleration"]), [0, 0, 9.81])


def test_free_fall_reads_nothing():
    seconds = np.arange(50) / RATE
    places = np.stack([0 * seconds, 2 * seconds, -9.81 / 2 * seconds**2], axis=1)
    assert np.allclose(readings(places, turning(50, 0).as_matrix(), RATE)["acceleration"], 0, atol=1e-9)


def test_on_a_circle_the_device_reads_what_holds_it_there():
    seconds, speed, radius = np.arange(100) / RATE, 3.0, 0.7
    angle = speed * seconds
    places = radius * np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1)
    read = readings(places, Rotation.from_euler("z", angle[:, None]).as_matrix(), RATE)
    assert np.allclose(read["acceleration"], [-(speed**2) * radius, 0, 9.81], atol=0.01)
    assert np.allclose(read["gyroscope"], [0, 0, speed], atol=1e-6)


def test_the_gyroscope_is_the_difference_of_slow_rotations():
    turns = turning(200, 1)
    expected = (turns[:-2].inv() * turns[2:]).as_rotvec() * RATE / 2
    assert np.allclose(readings(np.zeros((200, 3)), turns.as_matrix(), RATE)["gyroscope"], expected, atol=1e-9)


def test_adding_up_the_gyroscope_gives_the_rotation_back():
    turns = turning(2001, 2)
    steps = readings(np.zeros((2001, 3)), turns.as_matrix(), RATE)["gyroscope"] / RATE
    end = turns[1]
    for step in steps:
        end = end * Rotation.from_rotvec(step)
    assert (turns[-1].inv() * end).magnitude() < 0.05


@pytest.mark.parametrize(
    ("columns", "expected"),
    [
        (np.eye(3), (0, 0, 0)),
        (Rotation.from_euler("z", -90, degrees=True).as_matrix(), (90, 0, 0)),
        (Rotation.from_euler("z", 30, degrees=True).as_matrix(), (-30, 0, 0)),
        (Rotation.from_euler("x", 20, degrees=True).as_matrix(), (0, -20, 0)),
        (Rotation.from_euler("y", 25, degrees=True).as_matrix(), (0, 0, 25)),
    ],
)
def test_orientation_is_azimuth_pitch_and_roll(columns, expected):
    """A y axis to the north is azimuth 0, to the east 90; a top edge that goes up is a negative pitch."""
    assert np.allclose(still(columns)["orientation"], expected)


def test_noise_is_white_with_a_bias_that_drifts_and_stays_in_range():
    clean = {name: np.zeros((400, 300, 3)) for name in ("acceleration", "gyroscope", "orientation")}
    clean["orientation"] += 179.0
    clean["gyroscope"][0] = 100.0
    noisy = with_noise(clean, RATE, np.random.default_rng(0))
    acceleration = noisy["acceleration"]
    assert np.isclose(np.diff(acceleration, axis=0).std() / np.sqrt(2), 0.25, rtol=0.02)
    start, end = acceleration[:20].mean(axis=0), acceleration[-20:].mean(axis=0)
    assert np.isclose(start.std(), 0.3, rtol=0.15) and np.isclose((end - start).std(), 0.16, rtol=0.3)
    assert abs(start.mean()) < 0.05, "no direction is preferred"
    assert np.abs(noisy["orientation"]).max() > 178 and np.abs(noisy["orientation"][..., [0, 2]]).max() <= 180
    assert noisy["gyroscope"].max() == pytest.approx(np.radians(2000))


def test_slower_readings_are_means_but_not_of_angles():
    values = np.arange(10.0)[:, None]
    assert slower(values, 4, "acceleration")[:, 0].tolist() == [1.5, 5.5]
    assert slower(values, 4, "orientation")[:, 0].tolist() == [0, 4]
