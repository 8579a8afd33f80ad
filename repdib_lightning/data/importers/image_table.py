"""The CSV beside a folder of images: reading it, and turning its columns of text into numbers."""

from __future__ import annotations

import csv
import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from repdib_lightning.data.schema import FactorSpec
from repdib_lightning.errors import UserError, nearest
from repdib_lightning.records import ActionSpec

_MOST_CLASSES = 256
_LARGEST_KEPT_CLASS = 255
_BLANK = ("", "nan", "none", "null")


@dataclass(frozen=True)
class Table:
    """A CSV file: column name -> N texts. Line 1 is the header, so row r stands at line ``lines[r]``."""

    path: Path
    columns: dict[str, list[str]]
    lines: list[int]

    def __len__(self) -> int:
        return len(self.lines)

    def column(self, name: str, option: str) -> list[str]:
        """The texts of one column.

        Raises:
            UserError: no such column; names the option that asked for it and the columns that exist.
        """
        if name not in self.columns:
            raise UserError(f"{self.path}: {option}: no column '{name}', {nearest(name, self.columns)}")
        return self.columns[name]

    def is_number(self, name: str) -> bool:
        """Whether every cell that is not blank reads as a number."""
        return all(_number(text) is not None for text in self.columns[name] if not is_blank(text))


def read_table(path: Path) -> Table:
    """Read a CSV with a header line; comma, semicolon or tab.

    Raises:
        UserError: naming file and line: unreadable, empty, a repeated column name, a line of another length.
    """
    try:
        with open(path, newline="", encoding="utf-8-sig") as stream:
            first = stream.readline()
            stream.seek(0)
            reader = csv.reader(stream, delimiter=max(",;\t", key=first.count))
            numbered = [(reader.line_num, [cell.strip() for cell in row]) for row in reader if any(row)]
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise UserError(f"{path}: not a readable CSV file ({error})") from error
    if len(numbered) < 2:
        raise UserError(f"{path}: has no rows below its header line")
    header = [name or f"column_{index}" for index, name in enumerate(numbered[0][1])]
    repeated = sorted({name for name in header if header.count(name) > 1})
    if repeated:
        raise UserError(f"{path}: column '{repeated[0]}' appears more than once in the header")
    for line, row in numbered[1:]:
        if len(row) != len(header):
            raise UserError(f"{path}: line {line} has {len(row)} cells, the header has {len(header)}")
    columns = dict(zip(header, map(list, zip(*(row for _, row in numbered[1:]), strict=True)), strict=True))
    return Table(path, columns, [line for line, _ in numbered[1:]])


def is_blank(text: str) -> bool:
    """Whether a cell holds nothing."""
    return text.lower() in _BLANK


def _number(text: str) -> float | None:
    try:
        value = float(text)
    except ValueError:
        return None
    return value if math.isfinite(value) else None


@dataclass(frozen=True)
class Actions:
    """Actions of all rows: (N,) int64 or (N, A) float32; rows without one hold 0.

    ``classes`` are the texts or numbers that the integers stand for; None where they stand for themselves.
    """

    spec: ActionSpec
    values: np.ndarray
    classes: list[str] | None


def parse_actions(table: Table, names: list[str], void: np.ndarray, kind: str | None) -> Actions:
    """One column of whole numbers or texts becomes discrete, anything else continuous, unless ``kind`` says which.

    Args:
        table: the CSV.
        names: the action's column or columns.
        void: (N,) bool, rows whose action is not used and may be blank.
        kind: ``discrete`` or ``continuous``; None decides by the values.

    Raises:
        UserError: naming file, column and line: a blank action in the middle of an episode, text where numbers are
            needed, too many classes.
    """
    _check_blanks(table, names, void)
    known = ~np.array([any(is_blank(table.columns[name][row]) for name in names) for row in range(len(table))])
    numeric = all(table.is_number(name) for name in names)
    if kind is None:
        whole = numeric and all(float(table.columns[names[0]][row]).is_integer() for row in np.flatnonzero(known))
        kind = "discrete" if len(names) == 1 and (whole or not numeric) else "continuous"
    if kind == "continuous":
        if not numeric:
            raise UserError(f"{table.path}: continuous actions need numbers in the column(s) {', '.join(names)}")
        values = np.zeros((len(table), len(names)), np.float32)
        values[known] = [[float(table.columns[name][row]) for name in names] for row in np.flatnonzero(known)]
        return Actions(ActionSpec("continuous", len(names)), values, None)
    if len(names) > 1:
        raise UserError(f"{table.path}: discrete actions need one column, got {', '.join(names)}")
    texts = [table.columns[names[0]][row] for row in np.flatnonzero(known)]
    found, classes, size = _categories(table, names[0], texts)
    integers = np.zeros(len(table), np.int64)
    integers[known] = found
    return Actions(ActionSpec("discrete", size), integers, classes)


def _check_blanks(table: Table, names: list[str], void: np.ndarray) -> None:
    for name in names:
        for row in np.flatnonzero(~void):
            if is_blank(table.columns[name][row]):
                raise UserError(
                    f"{table.path}: column '{name}' is blank or NaN at line {table.lines[row]}, "
                    "in the middle of an episode"
                )


def parse_factor(
    table: Table, name: str, kind: str, scale: str | None
) -> tuple[FactorSpec, np.ndarray, list[str] | None]:
    """A factor's specification, its values (N,) and, where they were renumbered, the class names.

    Without ``scale``, text and whole numbers with at most 256 distinct values are categorical, the rest continuous.

    Raises:
        UserError: naming file, column and line: a blank cell, text in a continuous factor, too many classes.
    """
    texts = table.columns[name]
    for line, text in zip(table.lines, texts, strict=True):
        if is_blank(text):
            raise UserError(f"{table.path}: column '{name}' is blank or NaN at line {line}")
    numeric = table.is_number(name)
    if scale is None:
        few_whole = numeric and len(set(texts)) <= _MOST_CLASSES and all(float(text).is_integer() for text in texts)
        scale = "categorical" if few_whole or not numeric else "continuous"
    if scale == "categorical":
        values, classes, size = _categories(table, name, texts)
        return FactorSpec(kind, "categorical", size), values, classes  # type: ignore[arg-type]
    if not numeric:
        raise UserError(f"{table.path}: column '{name}' is text, it cannot be a continuous factor")
    return FactorSpec(kind, "continuous"), np.array([float(text) for text in texts], np.float32), None  # type: ignore[arg-type]


def _categories(table: Table, name: str, texts: list[str]) -> tuple[np.ndarray, list[str] | None, int]:
    """Integers, what they stand for (None: themselves), and the number of classes."""
    if table.is_number(name) and all(float(text).is_integer() for text in texts):
        integers = np.array([int(float(text)) for text in texts], np.int64)
        if integers.size and integers.min() >= 0 and integers.max() <= _LARGEST_KEPT_CLASS:
            return integers, None, int(integers.max()) + 1
        distinct, values = np.unique(integers, return_inverse=True)
        classes = [str(value) for value in distinct]
    else:
        classes = sorted(set(texts))
        place = {text: index for index, text in enumerate(classes)}
        values = np.array([place[text] for text in texts], np.int64)
    if len(classes) > _MOST_CLASSES:
        raise UserError(f"{table.path}: column '{name}' has {len(classes)} distinct values, too many to be classes")
    return values, classes, len(classes)
