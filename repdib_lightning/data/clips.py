"""What is there of the clips of a store: which steps of their videos and sequences were observed."""

from __future__ import annotations

from typing import Any

import numpy as np

from repdib_lightning.data.episodes import EpisodeStore

_READ_AT_ONCE = 2**26


def is_clip(store: EpisodeStore, name: str) -> bool:
    """Whether a row of an observation has steps of its own: a video, or a sequence of readings."""
    return store.observations[name].is_video or store.observations[name].is_sequence


def holds_clips(store: EpisodeStore) -> bool:
    """Whether any observation is a video or a sequence."""
    return any(is_clip(store, name) for name in store.observations)


def observed_steps(store: EpisodeStore, name: str) -> np.ndarray:
    """(N, T) bool: the frames of a video that are not all zeros, the steps of a sequence with any finite channel."""
    if store.observations[name].is_video:
        return _observed_frames(store.array(f"observations/{name}"))
    parts = store.parts(f"observations/{name}", _READ_AT_ONCE)
    return np.concatenate([np.isfinite(part).any(axis=-1) for part in parts])


def _observed_frames(videos: Any) -> np.ndarray:
    """(N, T, C, H, W) -> (N, T). The middle line of a frame nearly always tells; only of others the whole is read."""
    clips, middle = len(videos), videos.shape[3] // 2
    step = max(1, _READ_AT_ONCE // int(np.prod(videos.shape[1:])))
    lines = [videos[first : first + step, :, :, middle] for first in range(0, clips, step)]
    observed = np.concatenate([line.any(axis=(2, 3)) for line in lines])
    for clip in np.flatnonzero(~observed.all(axis=1)):
        observed[clip] = np.asarray(videos[int(clip)]).any(axis=(1, 2, 3))
    return observed


def lacks_channels(store: EpisodeStore, name: str) -> np.ndarray:
    """(N,) bool: the clips of which some channel of a sequence was never observed, and others were."""
    parts = store.parts(f"observations/{name}", _READ_AT_ONCE)
    seen = np.concatenate([np.isfinite(part).any(axis=1) for part in parts])
    return np.asarray(seen.any(axis=1) & ~seen.all(axis=1))
