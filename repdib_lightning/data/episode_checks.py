"""What an episode must look like to be written: nothing is cast, cut or filled in silently."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from numbers import Integral
from pathlib import Path
from typing import Any

import numpy as np

from repdib_lightning.data.schema import FactorSpec
from repdib_lightning.errors import UserError, nearest
from repdib_lightning.records import ActionSpec, ArraySpec

_RESERVED = ("format", "schema_version", "fingerprint")


@dataclass(frozen=True)
class Column:
    """One array of a store: what is handed in for each of the T rows of an episode, and how it is stored.

    Attributes:
        shape: of one row as handed in.
        dtype: as stored; for ``packed`` columns, bool is handed in and packed bits are stored.
        highest: largest valid integer (the smallest is 0), or None: whatever the dtype holds.
        filler: stored in the final row of an episode, for which nothing is handed in; None: T rows are handed in.
        finite: whether NaN and infinity are refused.
    """

    shape: tuple[int, ...]
    dtype: str
    highest: int | None = None
    filler: int | None = None
    finite: bool = False
    packed: bool = False

    @property
    def stored_shape(self) -> tuple[int, ...]:
        """Shape of one stored row."""
        return (*self.shape[:-1], -(-self.shape[-1] // 8)) if self.packed else self.shape

    @property
    def stored_dtype(self) -> str:
        """NumPy name of the stored dtype."""
        return "uint8" if self.packed else self.dtype

    def expected(self) -> str:
        """For messages: the array that has to be handed in."""
        steps = "T" if self.filler is None else "T - 1"
        sizes = ", ".join([steps, *map(str, self.shape)]) + ("" if self.shape else ",")
        return f"a numpy array of shape ({sizes}) {self.dtype}"


def columns_of(
    observations: dict[str, ArraySpec],
    actions: ActionSpec | None,
    factors: dict[str, FactorSpec],
    masks: dict[str, tuple[int, int]],
    rewards: bool,
) -> dict[str, Column]:
    """Key in the store -> column, in the order of allocation."""
    columns = {f"observations/{name}": Column(s.shape, s.dtype) for name, s in observations.items()}
    if actions is not None and actions.kind == "discrete":
        columns["actions"] = Column((), "int64", highest=actions.size - 1, filler=-1)
    elif actions is not None:
        columns["actions"] = Column((actions.size,), "float32", filler=0, finite=True)
    if rewards:
        columns["rewards"] = Column((), "float32", filler=0)
        columns |= {name: Column((), "bool", filler=0) for name in ("terminations", "truncations")}
    for name, factor in factors.items():
        shape = () if factor.width == 1 else (factor.width,)
        categorical = factor.scale == "categorical"
        highest = factor.classes - 1 if categorical else None
        columns[f"factors/{name}"] = Column(shape, "int64" if categorical else "float32", highest=highest)
    return columns | {f"masks/{name}": Column(tuple(size), "bool", packed=True) for name, size in masks.items()}


def check_stated(
    path: Path,
    rows: int,
    episodes: int,
    observations: dict[str, ArraySpec],
    actions: ActionSpec | None,
    factors: dict[str, FactorSpec],
    masks: dict[str, tuple[int, int]],
) -> None:
    """Refuse what no reader would accept, before anything is written.

    Raises:
        UserError: naming the argument of the writer that is wrong.
    """

    def demand(holds: bool, what: str) -> None:
        if not holds:
            raise UserError(f"{path}: {what}")

    demand(_counts(episodes) and _counts(rows) and rows >= episodes, f"rows={rows!r}, episodes={episodes!r}: " + _ROWS)
    groups: dict[str, Any] = {"observations": observations, "factors": factors, "masks": masks}
    for group, specs in groups.items():
        demand(isinstance(specs, Mapping), f"{group} must be a dict, is {type(specs).__name__}")
        for name in specs:
            plain = isinstance(name, str) and name not in ("", ".") and "/" not in name
            demand(plain, f"{group}: {name!r} is no name (text without '/')")
    demand(bool(observations), "observations is empty; state at least one")
    for name, spec in observations.items():
        key = f"'observations/{name}'"
        demand(isinstance(spec, ArraySpec), f"{key} must be an ArraySpec, is {type(spec).__name__}")
        demand(spec.dtype in ("uint8", "float32"), f"{key} is {spec.dtype!r}, must be uint8 or float32")
        demand(
            _is_shape(spec.shape), f"{key} has shape {spec.shape!r}, must be like (3, 64, 64) or (7,); a scalar is (1,)"
        )
    if actions is not None:
        demand(isinstance(actions, ActionSpec), f"actions must be an ActionSpec or None, is {type(actions).__name__}")
        demand(
            actions.kind in ("discrete", "continuous"),
            f"actions: kind is {actions.kind!r}, " + _hint(actions.kind, "discrete", "continuous"),
        )
        demand(_counts(actions.size), f"actions: size is {actions.size!r}, must be an integer of at least 1")
    for name, factor in factors.items():
        _check_factor(path, name, factor)
    for name, size in masks.items():
        demand(name in observations, f"'masks/{name}': there is no such observation, {nearest(name, observations)}")
        demand(_is_shape(size) and len(size) == 2, f"'masks/{name}' must be (height, width), is {size!r}")


_ROWS = "both must be integers of at least 1, with at least one row an episode"


def _check_factor(path: Path, name: str, factor: FactorSpec) -> None:
    key = f"{path}: 'factors/{name}'"
    if not isinstance(factor, FactorSpec):
        raise UserError(f"{key} must be a FactorSpec, is {type(factor).__name__}")
    if factor.kind not in ("endogenous", "exogenous"):
        raise UserError(f"{key}: kind is {factor.kind!r}, {_hint(factor.kind, 'endogenous', 'exogenous')}")
    if factor.scale not in ("categorical", "continuous"):
        raise UserError(f"{key}: scale is {factor.scale!r}, {_hint(factor.scale, 'categorical', 'continuous')}")
    if not _counts(factor.width) or (factor.scale == "categorical" and factor.width != 1):
        raise UserError(f"{key}: width is {factor.width!r}, must be 1 (categorical) or an integer of at least 1")
    if factor.scale == "categorical" and not _counts(factor.classes):
        raise UserError(f"{key}: is categorical with classes={factor.classes!r}, must be an integer of at least 1")


def _counts(value: Any) -> bool:
    return isinstance(value, Integral) and not isinstance(value, bool) and int(value) >= 1


def _is_shape(shape: Any) -> bool:
    return isinstance(shape, (tuple, list)) and len(shape) > 0 and all(_counts(size) for size in shape)


def _hint(word: Any, *choices: str) -> str:
    return nearest(str(word), choices)


def plain_attributes(path: Path, attributes: dict[str, Any]) -> dict[str, Any]:
    """Attributes as HDF5 holds them: text and numbers as they are, everything else as JSON.

    Raises:
        UserError: a name that the format uses itself, or a value that JSON cannot hold.
    """
    plain = {}
    for key, value in attributes.items():
        if key in _RESERVED:
            raise UserError(f"{path}: attribute '{key}' is set by the writer; choose another name")
        value = value.item() if isinstance(value, np.generic) else value
        try:
            plain[key] = value if isinstance(value, (str, int, float, bool)) else json.dumps(value, sort_keys=True)
        except (TypeError, ValueError) as error:
            raise UserError(f"{path}: attribute '{key}' cannot be written as JSON ({error})") from error
    return plain


def check_episode(where: str, columns: dict[str, Column], given: dict[str, Any]) -> dict[str, np.ndarray]:
    """The arrays of one episode as they are stored: key -> (T, ...).

    Args:
        where: file and episode, for messages.
        columns: what the writer was made for.
        given: key -> what was handed in.

    Raises:
        UserError: naming key, episode and what was expected.
    """
    for key in given:
        if key not in columns:
            raise UserError(f"{where}: the writer was made without '{key}', {nearest(key, columns)}")
    for key, column in columns.items():
        if key not in given:
            raise UserError(f"{where}: '{key}' is missing; expected {column.expected()}")
        if not isinstance(given[key], np.ndarray):
            kind = type(given[key]).__name__
            raise UserError(f"{where}: '{key}' is of type {kind}; expected {column.expected()}")
    first = given[next(iter(columns))]
    length = len(first) if first.ndim else 0
    if length < 1:
        raise UserError(
            f"{where}: '{next(iter(columns))}' has no row; expected {next(iter(columns.values())).expected()}"
        )
    return {
        key: _stored(f"{where}: '{key}'", column, given[key], length) for key, column in columns.items() if key in given
    }


def check_recording(where: str, recording: Any, *, stated: bool) -> int | None:
    """The number of the recording as it is stored, None where the writer was made without.

    Raises:
        UserError: naming the episode; it is missing, was not stated, or is no whole number from 0 on.
    """
    if not stated:
        if recording is None:
            return None
        raise UserError(f"{where}: recording is {recording!r}, but the writer was made without recordings=True")
    whole = isinstance(recording, Integral) and not isinstance(recording, bool)
    if not whole or not 0 <= int(recording) < 2**63:
        raise UserError(f"{where}: recording is {recording!r}; expected a whole number of at least 0")
    return int(recording)


def flat(where: str, groups: dict[str, Any], arrays: dict[str, Any]) -> dict[str, Any]:
    """Arguments of ``add_episode`` by key in the store; what is None was not handed in."""
    given: dict[str, Any] = {}
    for group, members in groups.items():
        if members is not None and not isinstance(members, Mapping):
            raise UserError(f"{where}: {group} is of type {type(members).__name__}; expected a dict of numpy arrays")
        given |= {f"{group}/{name}": array for name, array in (members or {}).items()}
    return given | {name: array for name, array in arrays.items() if array is not None}


def _stored(what: str, column: Column, array: np.ndarray, length: int) -> np.ndarray:
    rows = length if column.filler is None else length - 1
    if array.shape != (rows, *column.shape):
        raise UserError(f"{what} has shape {array.shape}; expected {column.expected()} with T = {length}")
    kinds = "biuf" if column.dtype == "float32" else "biu"
    if array.dtype.kind not in kinds:
        raise UserError(f"{what} is {array.dtype}; expected {column.expected()}")
    if column.dtype == "float32":
        stored = _as_float(what, column, array)
    else:
        _check_range(what, column, array)
        stored = np.ascontiguousarray(array, dtype=column.dtype)
    if column.packed:
        return np.packbits(stored, axis=-1)
    if column.filler is None:
        return stored
    return np.concatenate([stored, np.full((1, *column.shape), column.filler, dtype=stored.dtype)])


def _as_float(what: str, column: Column, array: np.ndarray) -> np.ndarray:
    with np.errstate(over="ignore"):  # refused below
        stored = np.ascontiguousarray(array, dtype=np.float32)
    if column.finite or array.dtype.itemsize > 4:
        wrong = ~np.isfinite(stored) if column.finite else ~np.isfinite(stored) & np.isfinite(array)
        if wrong.any():
            place = np.argwhere(wrong)[0]
            raise UserError(f"{what} holds {array[tuple(place)]} at row {place[0]}; expected finite float32 values")
    return stored


def _check_range(what: str, column: Column, array: np.ndarray) -> None:
    if (array.dtype == column.dtype and column.highest is None) or not array.size:
        return
    limits = (0, 1) if column.dtype == "bool" else (np.iinfo(column.dtype).min, np.iinfo(column.dtype).max)
    lowest, highest = limits if column.highest is None else (0, column.highest)
    for value in (array.min(), array.max()):
        if not lowest <= int(value) <= highest:
            row = int(np.argwhere(array == value)[0][0])
            raise UserError(f"{what} holds {value} at row {row}; expected integers in {lowest}..{highest}")
