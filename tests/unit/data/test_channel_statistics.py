"""Statistics of sequences are those of the observed training steps, whatever stands elsewhere."""

import time
import warnings

import h5py
import numpy as np
import pytest
from clip_stores import SENSORS, write_clips

from repdib_lightning.data import channel_statistics as module
from repdib_lightning.data.channel_statistics import channel_statistics, training_statistics
from repdib_lightning.data.datamodule import EpisodeDataModule
from repdib_lightning.data.episodes import EpisodeStore
from repdib_lightning.data.writer import EpisodeWriter
from repdib_lightning.records import ArraySpec


def write_readings(path, readings):
    """One clip a row: (N, T, X) float32."""
    spec = {"sensor": ArraySpec(readings.shape[1:], "float32")}
    with EpisodeWriter(path, rows=len(readings), episodes=len(readings), observations=spec, actions=None) as writer:
        for clip in readings:
            writer.add_episode(observations={"sensor": clip[None]})
    return EpisodeStore(path)


def slow(readings):
    """(n, T, X) -> mean and deviation (X,) of what is finite, one number at a time."""
    told = []
    for channel in np.moveaxis(readings.astype(np.float64), -1, 0):
        seen = [x for x in channel.reshape(-1) if np.isfinite(x)]
        told.append((np.mean(seen), np.std(seen)) if seen else (0.0, 1.0))
    return np.array(told).T


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("part", [2**24, 700])
def test_equal_to_a_slow_count_in_parts_of_any_size(tmp_path, monkeypatch, seed, part):
    random = np.random.default_rng(seed)
    scale = 10.0 ** random.integers(-3, 4, 5)
    readings = ((random.normal(size=(23, 7, 5)) + 50 * random.normal(size=5)) * scale).astype(np.float32)
    readings[random.random(readings.shape) < 0.2] = np.nan
    readings[random.random(23) < 0.3] = np.nan
    readings[3, 2, 1] = np.inf
    store = write_readings(tmp_path / "a.h5", readings)
    monkeypatch.setattr(module, "PART_BYTES", part)
    rows = np.flatnonzero(random.random(23) < 0.7)
    mean, deviation = channel_statistics(store, "sensor", rows)
    expected = slow(readings[rows])
    np.testing.assert_allclose(mean, expected[0], rtol=1e-9)
    np.testing.assert_allclose(deviation, expected[1], rtol=1e-6)


def test_constant_and_unseen_channels_can_be_divided_by(tmp_path):
    readings = np.random.default_rng(0).normal(size=(9, 4, 4)).astype(np.float32)
    readings[..., 1] = np.nan
    readings[..., 2] = 9.81
    readings[..., 3] = 0
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        mean, deviation = channel_statistics(write_readings(tmp_path / "a.h5", readings), "sensor", np.arange(9))
    assert mean[1:].tolist() == [0, pytest.approx(9.81), 0] and deviation[1:].tolist() == [1, 1, 1]


def test_what_is_held_out_changes_nothing(tmp_path):
    path = write_clips(tmp_path / "a.h5")
    data = EpisodeDataModule(str(path), 8, futures=0, held_out={"subject": [2]})
    data.setup()
    before = data.spec
    for name in SENSORS:
        shape = before.observations[name].shape
        assert len(before.observations[name].mean) == len(before.observations[name].std) == shape[-1]
    assert before.observations["cam1"].mean is None and before.observations["cam1"].std is None
    held_out = data.store.episodes("evaluation")
    with h5py.File(path, "r+") as file:
        for name in SENSORS:
            for row in held_out:
                file[f"observations/{name}"][row] = 1e6
    again = EpisodeDataModule(str(path), 8, futures=0, held_out={"subject": [2]})
    again.setup()
    assert again.spec == before
    other = EpisodeDataModule(str(path), 8, futures=0, held_out={"subject": [3]})
    other.setup()
    assert other.spec != before


def test_only_views_that_are_used_are_measured(tmp_path):
    store = EpisodeStore(write_clips(tmp_path / "a.h5"))
    assert list(training_statistics(store, ["cam1", "gyroscope"])) == ["gyroscope"]


def test_vectors_and_pictures_are_not_measured(store_file):
    data = EpisodeDataModule(str(store_file), 4)
    data.setup()
    assert all(spec.mean is None for spec in data.spec.observations.values())


def test_two_thousand_clips_take_less_than_a_second(tmp_path):
    readings = np.random.default_rng(0).normal(size=(2000, 200, 6)).astype(np.float32)
    store = write_readings(tmp_path / "a.h5", readings)
    began = time.process_time()
    training_statistics(store, ["sensor"])
    assert time.process_time() - began < 1.0
