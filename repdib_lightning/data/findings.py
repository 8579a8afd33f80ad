"""What is slow or suspicious in a store, each with what to do about it."""

from __future__ import annotations

from typing import Any

import h5py
import numpy as np

from repdib_lightning.data.clips import is_clip
from repdib_lightning.data.episodes import EpisodeStore
from repdib_lightning.data.inspection_text import file_size

_LARGEST_CHEAP_READ = 2.0


def layout_of(data: h5py.Dataset) -> str:
    """``contiguous``, or the chunk shape and its compression."""
    if data.chunks is None:
        return "contiguous" if data.id.get_offset() is not None else "not mappable"
    filters = data.compression or ("other filter" if _is_filtered(data) else "uncompressed")
    return f"chunks {'x'.join(map(str, data.chunks))}, {filters}"


def _is_filtered(data: h5py.Dataset) -> bool:
    return data.id.get_create_plist().get_nfilters() > 0


def slow_layouts(store: EpisodeStore) -> list[str]:
    """One line for each observation that cannot be memory-mapped: what reading one random frame costs.

    Measured on 20,000 frames of 84 px in the page cache, random batches of 256: one-frame chunks 70 to 110 times,
    uncompressed chunks of an episode 70 times, gzip chunks of an episode 6,000 times slower than a memory map.
    """
    lines = []
    with h5py.File(store.path, "r") as file:
        for name in store.observations:
            data = file[f"observations/{name}"]
            if layout_of(data) == "contiguous":
                continue
            frame = max(1, int(np.prod(data.shape[1:]))) * data.dtype.itemsize
            decoded = frame if data.chunks is None else _decoded_bytes(data)
            many_rows = decoded > _LARGEST_CHEAP_READ * frame
            pace = "thousands of times" if many_rows and _is_filtered(data) else "about 100 times"
            repacked = store.path.with_name(f"{store.path.stem}_contiguous.h5")
            what = "clip" if is_clip(store, name) else "frame"
            lines.append(
                f"'observations/{name}' is slow to read at random ({layout_of(data)}): one {what} of "
                f"{file_size(frame)} decodes {file_size(decoded)}, {pace} slower than contiguous; "
                f"run: python -m repdib_lightning import store {store.path} {repacked}"
            )
    return lines


def _decoded_bytes(data: h5py.Dataset) -> int:
    """Bytes of all the chunks that one row touches."""
    frame_chunks = [-(-extent // chunk) * chunk for extent, chunk in zip(data.shape[1:], data.chunks[1:], strict=True)]
    return int(data.chunks[0] * np.prod(frame_chunks, initial=1)) * data.dtype.itemsize


def suspicious_content(store: EpisodeStore, samples: dict[str, np.ndarray]) -> list[str]:
    """Lines on content that trains badly. ``samples``: observation -> (n, ...), evenly spread rows."""
    lines = []
    for name, rows in samples.items():
        if store.observations[name].is_sequence:
            lines += _dull_readings(name, rows)
        elif rows.min() == rows.max():
            lines.append(f"'observations/{name}' is {rows.min()} everywhere in {len(rows)} sampled rows: blank")
        if _is_stacked(store, name):
            lines.append(
                f"'observations/{name}' repeats earlier frames in its channels: it was stacked before it was stored; "
                "store single frames, they are stacked while loading"
            )
    if store.actions_spec is None:
        lines.append("there are no actions: objectives that predict them cannot be trained on this file")
    lines += _short_episodes(store)
    for name in store.factors:
        values = np.asarray(store.array(f"factors/{name}")[:])
        if (values == values[:1]).all():
            lines.append(f"'factors/{name}' never changes: a probe of it says nothing")
        if not np.isfinite(values).all():
            lines.append(f"'factors/{name}' holds NaN or infinite values")
    return lines + _unused_actions(store)


def _dull_readings(name: str, rows: np.ndarray) -> list[str]:
    """A line where sampled sequences, (n, T, X), hold nothing, or one value only; what is NaN was not observed."""
    observed = rows[np.isfinite(rows)]
    if not observed.size:
        return [f"'observations/{name}' is missing in all of {len(rows)} sampled clips"]
    if observed.min() == observed.max():
        return [f"'observations/{name}' is {observed[0]} wherever observed in {len(rows)} sampled clips: blank"]
    return []


def _short_episodes(store: EpisodeStore) -> list[str]:
    """A line where some episodes have one row; where all have, they are pictures and nothing is wrong."""
    short = int((store.lengths == 1).sum())
    if short in (0, len(store.lengths)):
        return []
    have = "episode has" if short == 1 else "episodes have"
    return [f"{short} {have} one row: sampled only with data.futures 0; any other number of futures is refused"]


def _is_stacked(store: EpisodeStore, name: str) -> bool:
    """Whether the older channels of a moving picture equal the newest ones of the row before."""
    spec = store.observations[name]
    if not spec.is_image or spec.shape[0] not in (6, 9, 12) or not (store.lengths > 1).any():
        return False
    episode = int(np.argmax(store.lengths))
    rows = store.starts[episode] + np.arange(min(int(store.lengths[episode]), 16))
    frames = store.gather(f"observations/{name}", rows)
    moved = (frames[1:, -3:] != frames[:-1, -3:]).any()
    return bool(moved and (frames[1:, -6:-3] == frames[:-1, -3:]).all())


def acting_rows(store: EpisodeStore) -> np.ndarray:
    """(n,) int64: all rows but the final one of each episode, which hold an action."""
    acting = np.ones(store.rows, bool)
    acting[store.starts + store.lengths - 1] = False
    return np.flatnonzero(acting)


def acted(store: EpisodeStore, key: str) -> np.ndarray:
    """The values of actions, rewards or ends in all rows that hold one."""
    values: Any = store.array(key)
    return np.asarray(values[:])[acting_rows(store)]


def _unused_actions(store: EpisodeStore) -> list[str]:
    if store.actions_spec is None or not len(acting_rows(store)):
        return []
    actions = acted(store, "actions")
    if store.actions_spec.kind == "discrete":
        unused = sorted(set(range(store.actions_spec.size)) - set(np.unique(actions).tolist()))
        return [f"discrete actions that never occur: {', '.join(map(str, unused[:12]))}"] if unused else []
    still = np.flatnonzero(np.ptp(actions, axis=0) == 0)
    return [f"action dimensions that never change: {', '.join(map(str, still[:12]))}"] if len(still) else []
