"""The reader of a store: opens, validates, and gathers rows through memory maps."""

from __future__ import annotations

import mmap
from collections.abc import Iterator
from functools import cached_property
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from repdib_lightning.data.class_names import stated_names
from repdib_lightning.data.held_out import HeldOut, as_names, held_out_episodes
from repdib_lightning.data.validation import (
    action_spec,
    attribute,
    check_episodes,
    check_format,
    check_recordings,
    check_rows,
    factor_spec,
    mask_width,
    members,
    observation_specs,
    per_episode,
)
from repdib_lightning.errors import UserError, nearest
from repdib_lightning.records import Split


class EpisodeStore:
    """Read-only view of one store (layout: :mod:`repdib_lightning.data.schema`).

    Contiguous arrays are memory-mapped at their offset in the file; nothing is loaded until it is indexed. The
    object pickles as its path, so worker processes map the file themselves.

    Args:
        path: the HDF5 file.
        held_out: names of values of categorical factors, such as {"subject": ["17", "18"]}: the episodes that have any
            of them are the evaluation split, whatever the file marks, and all others are for training.

    Attributes:
        evaluation: (E,) bool, what the file marks; the splits are those of :meth:`episodes`.
        recordings: (E,) int64, episodes cut of one recording share a number; all differ where the file has none.
        held_out: as given, each value as text; None where the file's own split holds.

    Raises:
        UserError: naming file, key and episode, if the file is missing, truncated, not a store, of a newer schema,
            or if its arrays disagree; or if what is held out is unknown, nothing, or everything.
    """

    def __init__(self, path: str | Path, held_out: HeldOut | None = None) -> None:
        self.path = Path(path)
        with self._open() as file:
            check_format(self.path, file)
            self.attributes: dict[str, Any] = {key: attribute(file, key) for key in file.attrs}
            self.observations = observation_specs(self.path, file)
            self._places: dict[str, tuple[int | None, tuple[int, ...], np.dtype[Any]]] = {}
            self._locate_all(file)
            self.starts = per_episode(self.path, file, "start")
            self.lengths = per_episode(self.path, file, "length")
            marked = "episodes/evaluation" in file
            marks = per_episode(self.path, file, "evaluation") if marked else np.zeros(len(self.starts))
            self.evaluation = marks.astype(bool)
            check_episodes(self.path, self.starts, self.lengths, self.evaluation, self.rows)
            self.recordings = self._read_recordings(file)
            self.actions_spec = action_spec(self.path, file, self.starts, self.lengths)
            factors, masks = members(self.path, file, "factors"), members(self.path, file, "masks")
            self.factors = {name: factor_spec(self.path, name, data) for name, data in factors}
            self.masks = {name: mask_width(self.path, name, data, self.observations) for name, data in masks}
        self._maps: dict[str, Any] = {}
        self.held_out = as_names(held_out)
        self._chosen = None if self.held_out is None else held_out_episodes(self, self.held_out)

    def _open(self) -> h5py.File:
        if not self.path.is_file():
            folder = self.path.parent
            there = [p.name for p in folder.glob("*.h5")] if folder.is_dir() else []
            raise UserError(f"{self.path}: no such data file, {nearest(self.path.name, there)}".rstrip(", "))
        try:
            return h5py.File(self.path, "r")
        except OSError as error:
            reason = "truncated" if "truncated" in str(error) else "not a readable HDF5 file"
            raise UserError(f"{self.path}: {reason} ({str(error).splitlines()[0]})") from error

    def _read_recordings(self, file: h5py.File) -> np.ndarray:
        if "episodes/recording" not in file:
            return np.arange(len(self.starts))
        recordings = per_episode(self.path, file, "recording")
        check_recordings(self.path, recordings, self.lengths)
        return recordings

    def _locate_all(self, file: h5py.File) -> None:
        """Where each array lies in the file, after a check that it has a row for every time step."""

        def locate(name: str, item: h5py.Dataset | h5py.Group) -> None:
            if isinstance(item, h5py.Dataset):
                here = item.chunks is None and item.shape is not None and item.file == file
                self._places[name] = (item.id.get_offset() if here else None, item.shape, item.dtype)

        file.visititems(locate)
        for group in ("observations", "factors", "masks"):  # links are not visited
            for name, data in members(self.path, file, group):
                locate(f"{group}/{name}", data)
        if "actions" in file:
            locate("actions", file["actions"])
        for name, (_, shape, _) in self._places.items():
            if not name.startswith("episodes/"):
                check_rows(self.path, name, shape, self.rows, self._first)

    @property
    def _first(self) -> str:
        return next(iter(self.observations))

    @property
    def rows(self) -> int:
        """N, final observations included."""
        return self._places[f"observations/{self._first}"][1][0]

    def __contains__(self, name: str) -> bool:
        """Whether there is an array of this key, such as ``rewards``."""
        return name in self._places

    @property
    def fingerprint(self) -> str:
        """Hash of the content as written; empty for files that another program wrote."""
        return str(self.attributes.get("fingerprint", ""))

    @cached_property
    def row_episodes(self) -> np.ndarray:
        """(N,) int64: the episode of each row."""
        return np.repeat(np.arange(len(self.starts)), self.lengths)

    @cached_property
    def row_recordings(self) -> np.ndarray:
        """(N,) int64: the recording of each row."""
        return np.repeat(self.recordings, self.lengths)

    def recording_of(self, episode: int) -> int | None:
        """The recording that the file states for an episode; None where it states none."""
        return int(self.recordings[episode]) if "episodes/recording" in self else None

    @cached_property
    def class_names(self) -> dict[str, list[str]]:
        """Categorical factor, or ``actions`` -> names of all its values, where the file states them."""
        counts = {name: spec.classes for name, spec in self.factors.items() if spec.scale == "categorical"}
        if self.actions_spec is not None and self.actions_spec.kind == "discrete":
            counts["actions"] = self.actions_spec.size
        return stated_names(self.attributes, counts)

    def value_names(self, factor: str) -> list[str]:
        """Names of all values of a categorical factor: as the file states them, or their numbers."""
        return self.class_names.get(factor) or [str(number) for number in range(self.factors[factor].classes)]

    @property
    def held_out_episodes(self) -> np.ndarray:
        """(E,) bool: those that are held out by factors, else those that the file marks, which may be none."""
        return self.evaluation if self._chosen is None else self._chosen

    def episodes(self, split: Split) -> np.ndarray:
        """Indices of the episodes of a split.

        For evaluation are those that are held out by factors, else those that are stored as such, else (nothing is
        stored) those of every fifth recording.
        """
        held_out = self.held_out_episodes
        if not held_out.any():
            held_out = np.unique(self.recordings, return_inverse=True)[1] % 5 == 4
        return np.flatnonzero(held_out if split == "evaluation" else ~held_out)

    def array(self, name: str) -> Any:
        """The whole array of a key, memory-mapped where it is contiguous, else a (slow) h5py data set.

        Actions, factors and rewards that are stored in another type or byte order are converted (copied) once:
        discrete actions and classes to int64, continuous actions to float32, all others to native byte order.

        Raises:
            UserError: the store has no such key.
        """
        if name not in self._places:
            raise UserError(f"{self.path}: has no key '{name}', {nearest(name, self._places)}")
        if name not in self._maps:
            offset, shape, dtype = self._places[name]
            wanted = self._dtype_in_memory(name, dtype)
            if dtype != wanted:
                with h5py.File(self.path, "r") as file:
                    self._maps[name] = file[name][:].astype(wanted)
            elif offset is None:
                self._maps[name] = h5py.File(self.path, "r")[name]
            else:
                self._maps[name] = np.memmap(self.path, dtype=dtype, mode="r", offset=offset, shape=shape)
        return self._maps[name]

    def let_go(self) -> None:
        """Give back the memory that mapped rows take in this process; they are read again where they are asked for."""
        for array in self._maps.values():
            if isinstance(array, np.memmap):
                array._mmap.madvise(mmap.MADV_DONTNEED)  # type: ignore[attr-defined]

    def _dtype_in_memory(self, name: str, stored: np.dtype[Any]) -> np.dtype[Any]:
        if name == "actions":
            assert self.actions_spec is not None
            return np.dtype(np.int64 if self.actions_spec.kind == "discrete" else np.float32)
        factor = self.factors.get(name.removeprefix("factors/")) if name.startswith("factors/") else None
        return np.dtype(np.int64) if factor and factor.scale == "categorical" else stored.newbyteorder("=")

    def layout(self, name: str) -> tuple[tuple[int, ...], np.dtype[Any]]:
        """Shape of a key's array, and its type in memory."""
        _, shape, dtype = self._places[name]
        return shape, self._dtype_in_memory(name, dtype)

    def parts(self, name: str, size: int) -> Iterator[np.ndarray]:
        """The whole array of a key in consecutive parts of at most ``size`` bytes (or one row), which are not kept."""
        shape, dtype = self.layout(name)
        step = max(1, size // (int(np.prod(shape[1:])) * dtype.itemsize))
        with h5py.File(self.path, "r") as file:
            for first in range(0, shape[0], step):
                yield file[name][first : first + step].astype(dtype, copy=False)

    def gather(self, name: str, rows: np.ndarray) -> np.ndarray:
        """Copy the given rows of one key, in any order and with repeats: (n,) int64 -> (n, ...)."""
        array = self.array(name)
        if isinstance(array, np.ndarray):
            return np.take(array, rows, axis=0)
        unique, inverse = np.unique(rows, return_inverse=True)
        return array[unique][inverse]

    def mask(self, name: str, rows: np.ndarray) -> np.ndarray:
        """Pixels of the agent in an observation: (n,) int64 -> (n, H, W) bool."""
        packed = self.gather(f"masks/{name}", rows)
        return np.unpackbits(packed, axis=-1, count=self.masks[name]).astype(bool)

    @property
    def contiguous(self) -> bool:
        """Whether every array can be memory-mapped."""
        return all(offset is not None for offset, _, _ in self._places.values())

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_maps": {}}
