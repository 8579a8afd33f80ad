"""The hash of a store's content: computed while it is written, recomputed to prove that nothing changed since."""

from __future__ import annotations

import hashlib

import h5py
import numpy as np
from tqdm import tqdm

from repdib_lightning.data.episodes import EpisodeStore
from repdib_lightning.data.sequential import SequentialRows


class ContentHash:
    """Hash over the episodes of a store, in order; within one, over its arrays in the order of their names.

    Layout, compression and attributes do not count: a repacked store keeps its fingerprint.
    """

    def __init__(self) -> None:
        self._hash = hashlib.blake2b(digest_size=16)

    def copy(self) -> ContentHash:
        """The same episodes so far; what is added to one is not added to the other."""
        twin = ContentHash()
        twin._hash = self._hash.copy()
        return twin

    def add_episode(self, arrays: dict[str, np.ndarray], *, evaluation: bool, recording: int | None = None) -> None:
        """Add the rows of one episode.

        Args:
            arrays: key in the store -> (T, ...), as stored.
            evaluation: whether it is held out.
            recording: what it was cut of; None where the store does not say.
        """
        length = len(next(iter(arrays.values())))
        cut_of = "" if recording is None else f" {recording}"
        self._hash.update(f"{length} {evaluation}{cut_of}".encode())
        for name, array in sorted(arrays.items()):
            self._hash.update(name.encode())
            self._hash.update(np.ascontiguousarray(array).view(np.uint8).data)

    def hexdigest(self) -> str:
        """32 hexadecimal digits."""
        return self._hash.hexdigest()


def recompute_fingerprint(store: EpisodeStore, *, progress: bool = False) -> str:
    """Hash what a store holds now; equals ``store.fingerprint`` exactly if nothing was changed since it was written.

    Raises:
        UserError: rows cannot be decoded.
    """
    content = ContentHash()
    with h5py.File(store.path, "r") as file:
        names: list[str] = []
        file.visititems(lambda name, item: names.append(name) if isinstance(item, h5py.Dataset) else None)
        columns = {name: SequentialRows(file[name]) for name in names if not name.startswith("episodes/")}
        with tqdm(total=store.rows, desc="verify", unit="row", disable=not progress) as bar:
            for episode, (start, length) in enumerate(zip(store.starts, store.lengths, strict=True)):
                rows = {name: column.read(int(start), int(start + length)) for name, column in columns.items()}
                evaluation, recording = bool(store.evaluation[episode]), store.recording_of(episode)
                content.add_episode(rows, evaluation=evaluation, recording=recording)
                bar.update(int(length))
    return content.hexdigest()
