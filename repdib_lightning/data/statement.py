"""What is stated of a store before its first row is written, and in what two statements differ."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import h5py
import numpy as np

from repdib_lightning.data.episode_checks import Column
from repdib_lightning.data.schema import FORMAT, SCHEMA_VERSION, FactorSpec
from repdib_lightning.data.validation import attribute
from repdib_lightning.records import ActionSpec

_LONGEST_SHOWN = 60
_RECORDING = "episodes/recording"


@dataclass(frozen=True)
class Statement:
    """Everything of a store but its rows.

    Attributes:
        rows: N.
        episodes: E.
        columns: key in the store -> column, in the order of allocation.
        actions: kind and width; None for data without actions.
        factors: name -> what is known of each factor.
        masks: observation name -> (H, W) of its agent mask.
        attributes: of the file, as HDF5 holds them.
        recordings: whether each episode states the recording that it was cut of.
    """

    rows: int
    episodes: int
    columns: dict[str, Column]
    actions: ActionSpec | None
    factors: dict[str, FactorSpec]
    masks: dict[str, tuple[int, int]]
    attributes: dict[str, Any]
    recordings: bool = False

    def attributes_of(self, key: str) -> dict[str, Any]:
        """Attributes of the data set of a column."""
        group, _, name = key.rpartition("/")
        if key == "actions" and self.actions is not None:
            return {"kind": self.actions.kind, "size": self.actions.size}
        if group == "factors":
            factor = self.factors[name]
            classes = {"classes": factor.classes} if factor.scale == "categorical" else {}
            return {"kind": factor.kind, "scale": factor.scale, **classes}
        return {"width": self.masks[name][1]} if group == "masks" else {}

    def facts(self) -> Facts:
        """All that is stated as plain values; equal to what :func:`stated_in` finds in a file that was made for it."""
        layout: dict[str, Any] = {"rows": self.rows, "episodes": self.episodes}
        for key, column in self.columns.items():
            layout[key] = _array(column.stored_shape, np.dtype(column.stored_dtype), self.attributes_of(key))
        if self.recordings:
            layout[_RECORDING] = _array((), np.dtype("int64"), {})
        fixed = {"format": FORMAT, "schema_version": SCHEMA_VERSION}
        return Facts(_options({**fixed, **self.attributes}), layout)


@dataclass(frozen=True)
class Facts:
    """A statement by names: options (attributes, the generating configuration's own one by one) and arrays."""

    options: dict[str, Any]
    layout: dict[str, Any]

    def differences(self, now: Facts) -> list[str]:
        """Lines like ``seed was 0, is 1``.

        Options come alone where one differs: other numbers of rows and other shapes follow from them.
        """
        return _differences(self.options, now.options) or _differences(self.layout, now.layout)


def stated_in(file: h5py.File) -> Facts:
    """What an open store was made for.

    Raises:
        KeyError: it lacks what every store has.
    """
    arrays: dict[str, Any] = {}
    counts: set[int] = set()

    def add(key: str, item: h5py.Dataset | h5py.Group) -> None:
        if isinstance(item, h5py.Dataset) and not key.startswith("episodes/"):
            arrays[key] = _array(item.shape[1:], item.dtype, {name: attribute(item, name) for name in item.attrs})
            counts.add(len(item))
        elif key == _RECORDING:
            arrays[key] = _array((), item.dtype, {})

    file.visititems(add)
    episodes = len(file["episodes/length"])
    if len(counts) != 1:
        raise KeyError("its arrays do not have the same number of rows")
    options = _options({name: attribute(file, name) for name in file.attrs if name != "fingerprint"})
    return Facts(options, {"rows": counts.pop(), "episodes": episodes} | arrays)


def _differences(before: dict[str, Any], now: dict[str, Any]) -> list[str]:
    def shown(facts: dict[str, Any], key: str) -> str:
        return _shortened(facts[key]) if key in facts else "absent"

    # repr: 1, 1.0 and True differ, NaN and NaN do not
    same = {key for key in before.keys() & now.keys() if repr(before[key]) == repr(now[key])}
    return [f"{key} was {shown(before, key)}, is {shown(now, key)}" for key in {**now, **before} if key not in same]


def _array(shape: tuple[int, ...], dtype: np.dtype[Any], attributes: dict[str, Any]) -> str:
    words = (f"{name}={value}" for name, value in sorted(attributes.items()))
    return " ".join(["x".join(map(str, shape)) or "scalar", str(dtype), *words])


def _options(attributes: dict[str, Any]) -> dict[str, Any]:
    configuration = _parsed(attributes.get("configuration", {}))
    found = dict(_leaves(configuration, "")) if isinstance(configuration, dict) else {"configuration": configuration}
    for name, value in sorted(attributes.items()):
        if name != "configuration":
            for key, leaf in _leaves(_parsed(value), name):
                if key not in found:
                    found[key] = leaf
                elif repr(found[key]) != repr(leaf):  # what is written twice, such as the seed, is told once
                    found[f"attribute {key}"] = leaf
    return found


def _parsed(value: Any) -> Any:
    if isinstance(value, str) and value.startswith("{"):
        try:
            return json.loads(value)
        except ValueError:
            return value
    return value


def _leaves(tree: Any, name: str) -> Iterator[tuple[str, Any]]:
    if isinstance(tree, dict) and (tree or not name):
        for key, value in tree.items():
            yield from _leaves(value, f"{name}.{key}" if name else str(key))
    else:
        yield name, tree


def _shortened(value: Any) -> str:
    line = " ".join(str(value).split())
    return line if len(line) <= _LONGEST_SHOWN else line[: _LONGEST_SHOWN - 1] + "…"
