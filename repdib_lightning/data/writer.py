"""Writes a store episode by episode; the file appears only when it is complete."""

from __future__ import annotations

import glob
import os
from pathlib import Path
from types import TracebackType
from typing import Any

import h5py
import numpy as np

from repdib_lightning.data.episode_checks import check_episode, check_stated, columns_of, flat, plain_attributes
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
        UserError: the path exists or is a folder, cannot be written, the disk is full, or what is stated cannot be a
            store; on leaving: fewer rows or episodes than stated were added (no file appears then).
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
        if self.path.is_dir():
            raise UserError(f"{self.path}: is a folder; name a file, such as {self.path / 'NAME.h5'}")
        if self.path.exists() and not overwrite:
            raise UserError(f"{self.path}: exists already; choose another file or pass --overwrite")
        factors, masks = factors or {}, masks or {}
        check_stated(self.path, rows, episodes, observations, actions, factors, masks)
        plain = plain_attributes(self.path, attributes or {})
        self.rows, self.episodes = rows, episodes
        self.observations, self.actions = observations, actions
        self._columns = columns_of(observations, actions, factors, masks, rewards)
        self._row = self._episode = 0
        self._hash = ContentHash()
        self._temporary = self.path.with_name(f".{self.path.name}.tmp-{os.getpid()}")
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            remove_leftovers(self.path)
            self._check_space(observations)
            self._file = h5py.File(self._temporary, "w")
        except OSError as error:
            raise self._cannot_write(error) from error
        try:
            self._allocate(factors, masks)
            self._file.attrs.update({"format": FORMAT, "schema_version": SCHEMA_VERSION, **plain})
        except (OSError, RuntimeError, ValueError) as error:  # HDF5's limits, such as 64 KiB an attribute
            self._discard()
            raise self._cannot_write(error) from error

    def _check_space(self, observations: dict[str, ArraySpec]) -> None:
        width = {"uint8": 1, "float32": 4}
        needed = self.rows * sum(int(np.prod(s.shape)) * width[s.dtype] for s in observations.values())
        status = os.statvfs(self.path.parent)
        if needed > status.f_bavail * status.f_frsize:
            free = status.f_bavail * status.f_frsize / 2**20
            raise UserError(f"{self.path}: cannot be written (needs {needed / 2**20:.0f} MiB, {free:.0f} MiB are free)")

    def _cannot_write(self, error: Exception) -> UserError:
        return UserError(f"{self.path}: cannot be written ({getattr(error, 'strerror', None) or error})")

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

    def _allocate(self, factors: dict[str, FactorSpec], masks: dict[str, tuple[int, int]]) -> None:
        for name, column in self._columns.items():
            self._dataset(name, (self.rows, *column.stored_shape), column.stored_dtype)
        if self.actions is not None:
            self._file["actions"].attrs.update({"kind": self.actions.kind, "size": self.actions.size})
        for name, factor in factors.items():
            attributes = self._file[f"factors/{name}"].attrs
            attributes.update({"kind": factor.kind, "scale": factor.scale})
            if factor.scale == "categorical":
                attributes["classes"] = factor.classes
        for name, (_, width) in masks.items():
            self._file[f"masks/{name}"].attrs["width"] = width
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

        Raises:
            UserError: an array that was stated is missing, one was not stated, or shape, type or values are not as
                stated (named with key and episode; nothing of the episode is written), the disk is full.
        """
        where = f"{self.path}: episode {self._episode}"
        if not self._file:
            raise UserError(f"{where}: the writer is closed; add episodes inside its `with` block")
        if not isinstance(evaluation, (bool, np.bool_)):
            raise UserError(f"{where}: evaluation is {evaluation!r}; expected True or False")
        groups = {"observations": observations, "factors": factors, "masks": masks}
        single = {"actions": actions, "rewards": rewards, "terminations": terminations, "truncations": truncations}
        arrays = check_episode(where, self._columns, flat(where, groups, single))
        length = len(next(iter(arrays.values())))
        rows = slice(self._row, self._row + length)
        if rows.stop > self.rows or self._episode >= self.episodes:
            stated = f"the writer was made for {self.rows} rows in {self.episodes} episodes"
            raise UserError(f"{where} ends at row {rows.stop}, but {stated}")
        evaluation = bool(evaluation)
        try:
            for name, array in arrays.items():
                self._file[name][rows] = array
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
        if (self._row, self._episode) != (self.rows, self.episodes):
            raise UserError(
                f"{self.path}: not written, {self._row} rows in {self._episode} episodes were added, "
                f"{self.rows} rows in {self.episodes} episodes were stated"
            )
        try:
            self._file.attrs["fingerprint"] = self._hash.hexdigest()
            self._file.close()
            sync_file(self._temporary)
            os.replace(self._temporary, self.path)
            sync_directory(self.path.parent)
        except OSError as error:
            raise self._cannot_write(error) from error


def remove_leftovers(path: Path) -> None:
    """Delete what processes that were killed while they wrote this file have left beside it."""
    for leftover in path.parent.glob(f".{glob.escape(path.name)}.tmp-*"):
        number = leftover.name.rpartition("-")[2]
        if number.isascii() and number.isdigit() and not _is_alive(int(number)):
            leftover.unlink(missing_ok=True)


def _is_alive(process: int) -> bool:
    try:
        os.kill(process, 0)
    except (ProcessLookupError, OverflowError):
        return False
    except PermissionError:  # it belongs to someone else
        return True
    return True
