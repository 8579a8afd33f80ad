"""Mean and standard deviation of each channel of a sequence, over the steps that were observed in training."""

from __future__ import annotations

import numpy as np

from repdib_lightning.data.episodes import EpisodeStore

PART_BYTES = 2**24
"""Readings that are held in memory at a time."""

_SMALLEST, _RELATIVE = 1e-12, 1e-6  # what rounding leaves of a channel that never changes


def training_statistics(store: EpisodeStore, names: list[str]) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Sequence -> mean (X,) and standard deviation (X,) float64 of its channels; other observations are passed over."""
    episodes = np.zeros(len(store.starts), bool)
    episodes[store.episodes("train")] = True
    rows = np.flatnonzero(episodes[store.row_episodes])
    sequences = [name for name in names if store.observations[name].is_sequence]
    return {name: channel_statistics(store, name, rows) for name in sequences}


def channel_statistics(store: EpisodeStore, name: str, rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Mean (X,) and standard deviation (X,) float64 of a sequence's channels in some rows, (n,) int64.

    What is not finite was not observed and does not count. A channel that never changes gets deviation 1; one that was
    never observed, mean 0 as well.
    """
    shape = store.observations[name].shape
    count, mean, squares = np.zeros(shape[-1]), np.zeros(shape[-1]), np.zeros(shape[-1])
    step = max(1, PART_BYTES // (4 * int(np.prod(shape))))
    for first in range(0, len(rows), step):
        part = store.gather(f"observations/{name}", rows[first : first + step]).reshape(-1, shape[-1])
        added, here, around = _moments(part)
        total = np.maximum(count + added, 1)
        apart = here - mean
        squares += around + apart**2 * count * added / total  # Chan, Golub & LeVeque 1983
        mean += apart * added / total
        count += added
    deviation = np.sqrt(squares / np.maximum(count, 1))
    return mean, np.where(deviation > np.maximum(_SMALLEST, _RELATIVE * np.abs(mean)), deviation, 1.0)


def _moments(readings: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Number, mean and sum of squares around it of each channel's finite readings: (n, X) -> three of (X,) float64."""
    observed = np.isfinite(readings)
    count = observed.sum(0).astype(np.float64)
    values = np.where(observed, readings, 0).astype(np.float64)
    mean = values.sum(0) / np.maximum(count, 1)
    return count, mean, (np.where(observed, values - mean, 0) ** 2).sum(0)
