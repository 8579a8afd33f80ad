"""What a store must look like to be read: any program may have written it, so a key is checked before it is used."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import h5py
import numpy as np

from repdib_lightning.data.schema import FORMAT, SCHEMA_VERSION, FactorSpec
from repdib_lightning.errors import UserError, nearest
from repdib_lightning.records import ActionSpec, ArraySpec


def attribute(owner: Any, name: str, default: Any = None) -> Any:
    """An attribute as plain Python: byte strings decoded, NumPy scalars and arrays of one element unpacked."""
    value = owner.attrs.get(name, default)
    if isinstance(value, np.ndarray) and value.size == 1:
        value = value.reshape(-1)[0]
    if isinstance(value, bytes):  # np.bytes_ is one
        return value.decode(errors="replace")
    return value.item() if isinstance(value, np.generic) else value


def _whole_number(path: Path, key: str, owner: Any, name: str, default: int, least: int) -> int:
    value = attribute(owner, name, default)
    if isinstance(value, bool) or not isinstance(value, (int, float)) or value != int(value) or value < least:
        raise UserError(f"{path}: attribute {name} of {key} is {value!r}, must be an integer of at least {least}")
    return int(value)


def check_format(path: Path, file: h5py.File) -> None:
    """Refuse what is no store, or one of a newer schema, or without the schema's groups.

    Raises:
        UserError: naming the file and the key.
    """
    if attribute(file, "format") != FORMAT:
        raise UserError(
            f"{path}: not a store of this package (keys: {', '.join(list(file)[:8]) or 'none'}); "
            "convert it with `python -m repdib_lightning import FORMAT PATH`, or mark a file in the store's layout "
            f"with the attributes format = {FORMAT!r}, schema_version = {SCHEMA_VERSION}"
        )
    if "schema_version" not in file.attrs:
        raise UserError(f"{path}: the file's attribute schema_version is missing; set it to {SCHEMA_VERSION}")
    version = _whole_number(path, "the file", file, "schema_version", 0, least=1)
    if version > SCHEMA_VERSION:
        raise UserError(
            f"{path}: schema version {version} is newer than this package reads ({SCHEMA_VERSION}); "
            "upgrade repdib_lightning"
        )
    for group in ("observations", "episodes", "factors", "masks"):
        if group in file and not isinstance(file[group], h5py.Group):
            raise UserError(f"{path}: '{group}' must be a group of data sets, is a data set")
    for key in ("observations", "episodes/start", "episodes/length"):
        if key not in file:
            raise UserError(f"{path}: key '{key}' is missing")
    for key in ("actions", "rewards", "terminations", "truncations"):
        if key in file and not isinstance(file[key], h5py.Dataset):
            raise UserError(f"{path}: '{key}' must be a data set, is a group")


def members(path: Path, file: h5py.File, group: str) -> list[tuple[str, h5py.Dataset]]:
    """Name and data set of each member of a group, sorted; none where there is no such group.

    Raises:
        UserError: a member is a group or a broken link.
    """
    found = sorted(file[group].items()) if group in file else []
    for name, item in found:
        if not isinstance(item, h5py.Dataset):
            what = "is a group" if isinstance(item, h5py.Group) else "leads nowhere"
            raise UserError(f"{path}: '{group}/{name}' must be a data set, {what}")
    return found


def per_episode(path: Path, file: h5py.File, name: str) -> np.ndarray:
    """(E,) int64: one array of the group ``episodes``. Raises UserError unless it holds one integer an episode."""
    data = file[f"episodes/{name}"]
    if not isinstance(data, h5py.Dataset) or data.shape is None or data.ndim != 1 or data.dtype.kind not in "biu":
        raise UserError(f"{path}: 'episodes/{name}' must be (E,) integers, is {_describe(data)}")
    return np.asarray(data[:]).astype(np.int64)


def _describe(data: Any) -> str:
    return f"{data.shape} {data.dtype}" if isinstance(data, h5py.Dataset) else "a group"


def check_rows(path: Path, key: str, shape: tuple[int, ...] | None, rows: int, first: str) -> None:
    """Raise UserError unless a data set has one row for each row of the first observation."""
    if not shape:
        raise UserError(f"{path}: '{key}' is a scalar; every data set holds one row a time step (keep it as attribute)")
    if shape[0] != rows:
        raise UserError(f"{path}: '{key}' has {shape[0]} rows, 'observations/{first}' has {rows}")


def observation_specs(path: Path, file: h5py.File) -> dict[str, ArraySpec]:
    """Shape and dtype of each observation.

    Raises:
        UserError: there is none, or one is of another dtype, or has no axis but that of the rows.
    """
    specs = {}
    for name, data in members(path, file, "observations"):
        key = f"'observations/{name}'"
        if not data.shape:
            check_rows(path, f"observations/{name}", data.shape, 0, name)
        if data.dtype not in (np.uint8, np.float32):
            shown = f"{data.dtype} (big-endian)" if data.dtype.byteorder == ">" else str(data.dtype)
            raise UserError(f"{path}: {key} is {shown}, must be uint8 or float32 in native (little-endian) byte order")
        if data.ndim < 2 or 0 in data.shape[1:]:
            raise UserError(
                f"{path}: {key} has shape {data.shape}, must be (N, X) or (N, C, H, W); a scalar is stored as (N, 1)"
            )
        specs[name] = ArraySpec(tuple(data.shape[1:]), "uint8" if data.dtype == np.uint8 else "float32")
    if not specs:
        raise UserError(f"{path}: 'observations' is empty")
    return specs


def check_episodes(path: Path, starts: np.ndarray, lengths: np.ndarray, evaluation: np.ndarray, rows: int) -> None:
    """Raise UserError, naming the episode, unless episodes follow each other without a gap and cover all rows."""
    if len(starts) != len(lengths) or len(starts) != len(evaluation):
        raise UserError(
            f"{path}: 'episodes/start' ({len(starts)}), 'episodes/length' ({len(lengths)}) and "
            f"'episodes/evaluation' ({len(evaluation)}) disagree"
        )
    if len(starts) == 0:
        raise UserError(f"{path}: 'episodes/start' is empty, the arrays hold {rows} rows; a store has an episode")
    ends = starts + lengths
    expected = np.concatenate([[0], ends[:-1]])
    wrong = np.flatnonzero((starts != expected) | (lengths < 1))
    if len(wrong):
        e = int(wrong[0])
        raise UserError(
            f"{path}: episode {e} starts at row {starts[e]} with length {lengths[e]}; row {expected[e]} was expected"
        )
    if ends[-1] != rows:
        raise UserError(f"{path}: episodes cover {int(ends[-1])} rows, the arrays hold {rows}")


def check_recordings(path: Path, recordings: np.ndarray, lengths: np.ndarray) -> None:
    """Raise UserError unless there is a recording for each episode."""
    if len(recordings) != len(lengths):
        raise UserError(
            f"{path}: 'episodes/recording' ({len(recordings)}) and 'episodes/length' ({len(lengths)}) disagree"
        )


def action_spec(path: Path, file: h5py.File, starts: np.ndarray, lengths: np.ndarray) -> ActionSpec | None:
    """Kind and size of the actions, whose values are checked in every row that holds one.

    Raises:
        UserError: naming row, episode and step of a wrong value.
    """
    if "actions" not in file:
        return None
    data = file["actions"]
    integers = data.dtype.kind in "iu"
    kind = attribute(data, "kind", "discrete" if integers else "continuous")
    if kind not in ("discrete", "continuous"):
        choices = ("discrete", "continuous")
        raise UserError(f"{path}: attribute kind of 'actions' is {kind!r}, {nearest(str(kind), choices)}")
    if kind == "discrete" and (not integers or data.ndim != 1):
        raise UserError(f"{path}: discrete 'actions' must be (N,) integers, are {_describe(data)}")
    if kind == "continuous" and (data.dtype.kind not in "fiu" or data.ndim != 2 or data.shape[1] == 0):
        raise UserError(f"{path}: continuous 'actions' must have shape (N, A) of real numbers, are {_describe(data)}")
    actions = data[:]
    acting = np.ones(len(actions), bool)
    acting[starts + lengths - 1] = False
    if kind == "discrete":
        default = int(actions[acting].max()) + 1 if acting.any() else 1
        spec = ActionSpec(kind, _whole_number(path, "'actions'", data, "size", max(1, default), least=1))
        wrong, what = (actions < 0) | (actions >= spec.size), "is out of range"
    else:
        spec = ActionSpec(kind, _whole_number(path, "'actions'", data, "size", data.shape[1], least=1))
        if spec.size != data.shape[1]:
            raise UserError(f"{path}: attribute size of 'actions' is {spec.size}, their shape is {data.shape}")
        wrong, what = ~np.isfinite(actions).all(axis=-1), "is not finite (NaN or infinite)"
    bad = np.flatnonzero(wrong & acting)
    if len(bad):
        row = int(bad[0])
        episode = int(np.searchsorted(starts, row, side="right") - 1)
        raise UserError(
            f"{path}: 'actions' {what} at row {row} (episode {episode}, step {row - starts[episode]}): "
            f"{actions[row]}; {len(bad)} such rows"
        )
    return spec


def factor_spec(path: Path, name: str, data: h5py.Dataset) -> FactorSpec:
    """What is known of a factor. Raises UserError if attributes, dtype or shape do not describe one."""
    key = f"'factors/{name}'"
    kind = attribute(data, "kind")
    if kind not in ("endogenous", "exogenous"):
        raise UserError(f"{path}: {key} needs an attribute kind = endogenous | exogenous")
    if data.dtype.kind not in "biuf" or data.ndim > 2 or 0 in data.shape[1:]:
        raise UserError(f"{path}: {key} must be numbers of shape (N,) or (N, width), is {_describe(data)}")
    integers = data.dtype.kind in "biu"
    scale = attribute(data, "scale", "categorical" if integers else "continuous")
    if scale not in ("categorical", "continuous"):
        choices = ("categorical", "continuous")
        raise UserError(f"{path}: attribute scale of {key} is {scale!r}, {nearest(str(scale), choices)}")
    width = data.shape[1] if data.ndim == 2 else 1
    if scale == "continuous":
        return FactorSpec(kind, scale, 0, width)
    if not integers or width != 1:
        raise UserError(f"{path}: categorical {key} must be (N,) integers, is {_describe(data)}")
    largest = int(data[:].max())
    classes = _whole_number(path, key, data, "classes", max(1, largest + 1), least=1)
    if largest >= classes:
        raise UserError(f"{path}: {key} holds class {largest}, its attribute classes is {classes} (0..{classes - 1})")
    return FactorSpec(kind, scale, classes, width)


def mask_width(path: Path, name: str, data: h5py.Dataset, observations: dict[str, ArraySpec]) -> int:
    """W of a bit-packed mask. Raises UserError if it belongs to no observation or is not packed as it says."""
    key = f"'masks/{name}'"
    if name not in observations:
        raise UserError(f"{path}: {key} is the mask of no observation, {nearest(name, observations)}")
    if "width" not in data.attrs:
        raise UserError(f"{path}: {key} needs an attribute width: the pixels of a row before they were packed")
    width = _whole_number(path, key, data, "width", 0, least=1)
    if data.dtype != np.uint8 or data.ndim != 3 or data.shape[2] != -(-width // 8):
        raise UserError(
            f"{path}: {key} must be (N, H, {-(-width // 8)}) uint8, bit-packed for width {width}, is {_describe(data)}"
        )
    return width
