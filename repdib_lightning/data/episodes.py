"""The reader of a store: opens, validates, and gathers rows through memory maps."""

from __future__ import annotations

from functools import cached_property
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from repdib_lightning.data.schema import FORMAT, SCHEMA_VERSION, FactorSpec
from repdib_lightning.errors import UserError, nearest
from repdib_lightning.records import ActionSpec, ArraySpec, Split


class EpisodeStore:
    """Read-only view of one store (layout: :mod:`repdib_lightning.data.schema`).

    Contiguous arrays are memory-mapped at their offset in the file; nothing is loaded until it is indexed. The
    object pickles as its path, so worker processes map the file themselves.

    Args:
        path: the HDF5 file.

    Raises:
        UserError: naming file, key and episode, if the file is missing, truncated, not a store, of a newer schema,
            or if its arrays disagree.
    """

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        with self._open() as file:
            self._check_format(file)
            self.attributes: dict[str, Any] = {
                key: value.item() if isinstance(value, np.generic) else value for key, value in file.attrs.items()
            }
            self.starts = file["episodes/start"][:].astype(np.int64)
            self.lengths = file["episodes/length"][:].astype(np.int64)
            marked = "episodes/evaluation" in file
            self.evaluation = (
                file["episodes/evaluation"][:].astype(bool) if marked else np.zeros(len(self.starts), bool)
            )
            self.observations = _observation_specs(file)
            self.actions_spec = _action_spec(self.path, file)
            self.factors = {name: _factor_spec(self.path, name, data) for name, data in _members(file, "factors")}
            self.masks = {name: int(data.attrs["width"]) for name, data in _members(file, "masks")}
            self._places: dict[str, tuple[int | None, tuple[int, ...], np.dtype[Any]]] = {}
            file.visititems(self._locate)
        self._check_lengths()
        self._check_actions()
        self._maps: dict[str, Any] = {}

    def _open(self) -> h5py.File:
        if not self.path.is_file():
            folder = self.path.parent
            there = [p.name for p in folder.glob("*.h5")] if folder.is_dir() else []
            raise UserError(f"{self.path}: no such data file {nearest(self.path.name, there)}".rstrip())
        try:
            return h5py.File(self.path, "r")
        except OSError as error:
            reason = "truncated" if "truncated" in str(error) else "not a readable HDF5 file"
            raise UserError(f"{self.path}: {reason} ({str(error).splitlines()[0]})") from error

    def _check_format(self, file: h5py.File) -> None:
        if file.attrs.get("format") != FORMAT:
            raise UserError(
                f"{self.path}: not a store of this package (keys: {', '.join(list(file)[:8]) or 'none'}); "
                "convert it with `python -m repdib_lightning import FORMAT PATH`"
            )
        version = int(file.attrs["schema_version"])
        if version > SCHEMA_VERSION:
            raise UserError(
                f"{self.path}: schema version {version} is newer than this package reads ({SCHEMA_VERSION}); "
                "upgrade repdib_lightning"
            )
        for key in ("observations", "episodes/start", "episodes/length"):
            if key not in file:
                raise UserError(f"{self.path}: key '{key}' is missing")

    def _locate(self, name: str, item: h5py.Dataset | h5py.Group) -> None:
        if isinstance(item, h5py.Dataset):
            offset = item.id.get_offset() if item.chunks is None else None
            self._places[name] = (offset, item.shape, item.dtype)

    def _check_lengths(self) -> None:
        for name, (_, shape, _) in self._places.items():
            if not name.startswith("episodes/") and shape[0] != self.rows:
                raise UserError(
                    f"{self.path}: '{name}' has {shape[0]} rows, 'observations/{self._first}' has {self.rows}"
                )
        if len(self.starts) != len(self.lengths) or len(self.starts) != len(self.evaluation):
            raise UserError(
                f"{self.path}: 'episodes/start' ({len(self.starts)}), 'episodes/length' ({len(self.lengths)}) and "
                f"'episodes/evaluation' ({len(self.evaluation)}) disagree"
            )
        ends = self.starts + self.lengths
        expected = np.concatenate([[0], ends[:-1]])
        wrong = np.flatnonzero((self.starts != expected) | (self.lengths < 1))
        if len(wrong):
            e = int(wrong[0])
            raise UserError(
                f"{self.path}: episode {e} starts at row {self.starts[e]} with length {self.lengths[e]}; "
                f"row {expected[e]} was expected"
            )
        if len(ends) == 0 or ends[-1] != self.rows:
            held = int(ends[-1]) if len(ends) else 0
            raise UserError(f"{self.path}: episodes cover {held} rows, the arrays hold {self.rows}")

    def _check_actions(self) -> None:
        if self.actions_spec is None:
            return
        with h5py.File(self.path, "r") as file:
            actions = file["actions"][:]
        acting = np.ones(self.rows, bool)
        acting[self.starts + self.lengths - 1] = False
        if self.actions_spec.kind == "continuous":
            wrong, what = ~np.isfinite(actions).all(axis=-1), "is not finite (NaN or infinite)"
        else:
            wrong, what = (actions < 0) | (actions >= self.actions_spec.size), "is out of range"
        bad = np.flatnonzero(wrong & acting)
        if len(bad):
            row = int(bad[0])
            episode = int(np.searchsorted(self.starts, row, side="right") - 1)
            raise UserError(
                f"{self.path}: 'actions' {what} at row {row} (episode {episode}, step {row - self.starts[episode]}): "
                f"{actions[row]}; {len(bad)} such rows"
            )

    @property
    def _first(self) -> str:
        return next(iter(self.observations))

    @property
    def rows(self) -> int:
        """N, final observations included."""
        return self._places[f"observations/{self._first}"][1][0]

    @property
    def fingerprint(self) -> str:
        """Hash of the content as written; empty for files that another program wrote."""
        return str(self.attributes.get("fingerprint", ""))

    @cached_property
    def row_episodes(self) -> np.ndarray:
        """(N,) int64: the episode of each row."""
        return np.repeat(np.arange(len(self.starts)), self.lengths)

    def episodes(self, split: Split) -> np.ndarray:
        """Indices of the episodes of a split: stored as such, or (nothing stored) every fifth is for evaluation."""
        held_out = self.evaluation if self.evaluation.any() else np.arange(len(self.starts)) % 5 == 4
        return np.flatnonzero(held_out if split == "evaluation" else ~held_out)

    def array(self, name: str) -> Any:
        """The whole array of a key, memory-mapped where it is contiguous, else a (slow) h5py data set.

        Raises:
            UserError: the store has no such key.
        """
        if name not in self._places:
            raise UserError(f"{self.path}: has no key '{name}' {nearest(name, self._places)}")
        if name not in self._maps:
            offset, shape, dtype = self._places[name]
            if offset is None:
                self._maps[name] = h5py.File(self.path, "r")[name]
            else:
                self._maps[name] = np.memmap(self.path, dtype=dtype, mode="r", offset=offset, shape=shape)
        return self._maps[name]

    def gather(self, name: str, rows: np.ndarray) -> np.ndarray:
        """Copy the given rows of one key, in any order and with repeats: (n,) int64 -> (n, ...)."""
        array = self.array(name)
        if isinstance(array, np.memmap):
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


def _members(file: h5py.File, group: str) -> list[tuple[str, h5py.Dataset]]:
    return sorted(file[group].items()) if group in file else []


def _observation_specs(file: h5py.File) -> dict[str, ArraySpec]:
    specs = {}
    for name, data in _members(file, "observations"):
        if data.dtype not in (np.uint8, np.float32):
            raise UserError(f"{file.filename}: 'observations/{name}' is {data.dtype}, must be uint8 or float32")
        specs[name] = ArraySpec(tuple(data.shape[1:]), "uint8" if data.dtype == np.uint8 else "float32")
    if not specs:
        raise UserError(f"{file.filename}: 'observations' is empty")
    return specs


def _action_spec(path: Path, file: h5py.File) -> ActionSpec | None:
    if "actions" not in file:
        return None
    data = file["actions"]
    kind = data.attrs.get("kind", "discrete" if np.issubdtype(data.dtype, np.integer) else "continuous")
    if kind == "continuous" and data.ndim != 2:
        raise UserError(f"{path}: continuous 'actions' must have shape (N, A), has {data.shape}")
    default = int(data[:].max()) + 1 if kind == "discrete" else data.shape[-1]
    return ActionSpec(kind, int(data.attrs.get("size", default)))


def _factor_spec(path: Path, name: str, data: h5py.Dataset) -> FactorSpec:
    if data.attrs.get("kind") not in ("endogenous", "exogenous"):
        raise UserError(f"{path}: 'factors/{name}' needs an attribute kind = endogenous | exogenous")
    categorical = np.issubdtype(data.dtype, np.integer)
    scale = data.attrs.get("scale", "categorical" if categorical else "continuous")
    classes = int(data.attrs.get("classes", int(data[:].max()) + 1 if scale == "categorical" else 0))
    width = data.shape[1] if data.ndim == 2 else 1
    return FactorSpec(data.attrs["kind"], scale, classes, width)
