"""Writes a store episode by episode; the file appears only when it is complete."""

from __future__ import annotations

import json
import os
from pathlib import Path
from types import TracebackType
from typing import Any

import h5py
import numpy as np

from repdib_lightning.data.files import sync_directory, sync_file
from repdib_lightning.data.fingerprint import ContentHash
from repdib_lightning.data.schema import FORMAT, SCHEMA_VERSION, FactorSpec
from repdib_lightning.errors import UserError
from repdib_lightning.records import ActionSpec, ArraySpec


class EpisodeWriter:
    """Writes one store. The number of rows and episodes is stated first, so that every array is contiguous.

    Use as a context manager: leaving it normally publishes the file (flush, rename), leaving it by an error removes
    what was written.

    Args:
        path: the file to make; must not exist unless ``overwrite``.
        rows: N, over all episodes (final observations included).
        episodes: E.
        observations: name -> shape and dtype of one un-stacked observation.
        actions: kind and width; None for data without actions.
        factors: name -> what is known of each ground-truth factor.
        masks: observation name -> (H, W) of its agent mask.
        rewards: whether rewards, terminations and truncations are written.
        attributes: environment, generating configuration, seed, licence; plain values, nested ones become JSON.

    Raises:
        UserError: the path exists, cannot be written, or the disk is full.
    """

    def __init__(
        self,
        path: str | Path,
        *,
        rows: int,
        episodes: int,
        observations: dict[str, ArraySpec],
        actions: ActionSpec | None,
        factors: dict[str, FactorSpec] | None = None,
        masks: dict[str, tuple[int, int]] | None = None,
        rewards: bool = False,
        attributes: dict[str, Any] | None = None,
        overwrite: bool = False,
    ) -> None:
        self.path = Path(path)
        if self.path.exists() and not overwrite:
            raise UserError(f"{self.path}: exists already; choose another file or pass --overwrite")
        self.rows, self.episodes = rows, episodes
        self.observations, self.actions = observations, actions
        self._row = self._episode = 0
        self._hash = ContentHash()
        self._temporary = self.path.with_name(f".{self.path.name}.tmp-{os.getpid()}")
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            self._check_space(observations)
            self._file = h5py.File(self._temporary, "w")
        except OSError as error:
            raise self._cannot_write(error) from error
        try:
            self._allocate(factors or {}, masks or {}, rewards)
        except OSError as error:
            self._discard()
            raise self._cannot_write(error) from error
        self._file.attrs.update({"format": FORMAT, "schema_version": SCHEMA_VERSION})
        for key, value in (attributes or {}).items():
            plain = isinstance(value, (str, int, float, bool))
            self._file.attrs[key] = value if plain else json.dumps(value, sort_keys=True)

    def _check_space(self, observations: dict[str, ArraySpec]) -> None:
        width = {"uint8": 1, "float32": 4}
        needed = self.rows * sum(int(np.prod(s.shape)) * width[s.dtype] for s in observations.values())
        status = os.statvfs(self.path.parent)
        if needed > status.f_bavail * status.f_frsize:
            free = status.f_bavail * status.f_frsize / 2**20
            raise UserError(f"{self.path}: cannot be written (needs {needed / 2**20:.0f} MiB, {free:.0f} MiB are free)")

    def _cannot_write(self, error: OSError) -> UserError:
        return UserError(f"{self.path}: cannot be written ({error.strerror or error})")

    def _dataset(self, name: str, shape: tuple[int, ...], dtype: str) -> h5py.Dataset:
        """A contiguous data set whose place in the file is fixed now, so that it can be memory-mapped."""
        layout = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
        layout.set_layout(h5py.h5d.CONTIGUOUS)
        layout.set_alloc_time(h5py.h5d.ALLOC_TIME_EARLY)
        layout.set_fill_time(h5py.h5d.FILL_TIME_NEVER)
        layout.set_obj_track_times(False)
        parent = self._file.require_group(name.rpartition("/")[0] or "/")
        leaf = name.rpartition("/")[2].encode()
        space = h5py.h5s.create_simple(shape)
        kind = h5py.h5t.py_create(np.dtype(dtype), logical=True)
        return h5py.Dataset(h5py.h5d.create(parent.id, leaf, kind, space, layout))

    def _allocate(self, factors: dict[str, FactorSpec], masks: dict[str, tuple[int, int]], rewards: bool) -> None:
        for name, spec in self.observations.items():
            self._dataset(f"observations/{name}", (self.rows, *spec.shape), spec.dtype)
        if self.actions is not None:
            discrete = self.actions.kind == "discrete"
            shape = (self.rows,) if discrete else (self.rows, self.actions.size)
            actions = self._dataset("actions", shape, "int64" if discrete else "float32")
            actions.attrs.update({"kind": self.actions.kind, "size": self.actions.size})
        if rewards:
            self._dataset("rewards", (self.rows,), "float32")
            self._dataset("terminations", (self.rows,), "bool")
            self._dataset("truncations", (self.rows,), "bool")
        for name, factor in factors.items():
            categorical = factor.scale == "categorical"
            shape = (self.rows,) if factor.width == 1 else (self.rows, factor.width)
            values = self._dataset(f"factors/{name}", shape, "int64" if categorical else "float32")
            values.attrs.update({"kind": factor.kind, "scale": factor.scale})
            if categorical:
                values.attrs["classes"] = factor.classes
        for name, (height, width) in masks.items():
            mask = self._dataset(f"masks/{name}", (self.rows, height, -(-width // 8)), "uint8")
            mask.attrs["width"] = width
        for name in ("start", "length"):
            self._dataset(f"episodes/{name}", (self.episodes,), "int64")
        self._dataset("episodes/evaluation", (self.episodes,), "bool")

    def add_episode(
        self,
        *,
        observations: dict[str, np.ndarray],
        actions: np.ndarray | None = None,
        rewards: np.ndarray | None = None,
        terminations: np.ndarray | None = None,
        truncations: np.ndarray | None = None,
        factors: dict[str, np.ndarray] | None = None,
        masks: dict[str, np.ndarray] | None = None,
        evaluation: bool = False,
    ) -> None:
        """Append one episode of T rows.

        Args:
            observations: name -> (T, ...).
            actions: (T - 1,) or (T - 1, A); the final row gets the placeholder.
            rewards, terminations, truncations: (T - 1,); required where the writer was made with ``rewards``.
            factors: name -> (T, ...).
            masks: observation name -> (T, H, W) bool.
            evaluation: the episode is never trained on.
        """
        length = len(next(iter(observations.values())))
        rows = slice(self._row, self._row + length)
        assert rows.stop <= self.rows and self._episode < self.episodes, "more rows or episodes than stated"
        arrays = {f"observations/{name}": array for name, array in observations.items()}
        if actions is not None:
            assert self.actions is not None
            filler = -1 if self.actions.kind == "discrete" else 0
            arrays["actions"] = _with_final_row(actions, filler)
        outcome = {"rewards": rewards, "terminations": terminations, "truncations": truncations}
        arrays |= {name: _with_final_row(array, 0) for name, array in outcome.items() if array is not None}
        arrays |= {f"factors/{name}": array for name, array in (factors or {}).items()}
        arrays |= {f"masks/{name}": np.packbits(array, axis=-1) for name, array in (masks or {}).items()}
        try:
            for name, array in arrays.items():
                dataset = self._file[name]
                assert array.shape == (length, *dataset.shape[1:]), (name, array.shape, dataset.shape)
                arrays[name] = np.ascontiguousarray(array, dtype=dataset.dtype)
                dataset[rows] = arrays[name]
            self._hash.add_episode(arrays, evaluation=evaluation)
            self._file["episodes/start"][self._episode] = rows.start
            self._file["episodes/length"][self._episode] = length
            self._file["episodes/evaluation"][self._episode] = evaluation
        except OSError as error:
            raise self._cannot_write(error) from error
        self._row, self._episode = rows.stop, self._episode + 1

    def __enter__(self) -> EpisodeWriter:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        try:
            if kind is None:
                self._publish()
        finally:
            self._discard()

    def _discard(self) -> None:
        if self._file:
            self._file.close()
        self._temporary.unlink(missing_ok=True)

    def _publish(self) -> None:
        filled = (self._row, self._episode)
        assert filled == (self.rows, self.episodes), f"stated {self.rows, self.episodes}, wrote {filled}"
        try:
            self._file.attrs["fingerprint"] = self._hash.hexdigest()
            self._file.close()
            sync_file(self._temporary)
            os.replace(self._temporary, self.path)
            sync_directory(self.path.parent)
        except OSError as error:
            raise self._cannot_write(error) from error


def _with_final_row(array: np.ndarray, filler: int) -> np.ndarray:
    """(T - 1, ...) -> (T, ...): the final observation has no action, reward or end."""
    return np.concatenate([array, np.full((1, *array.shape[1:]), filler, dtype=array.dtype)])
