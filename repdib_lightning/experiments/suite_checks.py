"""Checks of what a suite's file says; each raises a UserError of one line that names the file and the key."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from repdib_lightning.errors import UserError, nearest


def listed(value: Any) -> list[Any]:
    """A list as it is; anything else as a list of one."""
    return value if isinstance(value, list) else [value]


def mapping(file: Path, key: str, value: Any) -> dict[str, Any]:
    """A mapping, or an empty one for None."""
    if value is None:
        return {}
    if not isinstance(value, dict):
        raise UserError(f"{file}: {key} must map names to values, is {value!r:.60}")
    return value


def words(file: Path, key: str, value: Any, choices: Sequence[str] | None = None) -> tuple[str, ...]:
    """A list of words, all of them among ``choices`` where those are given."""
    if not isinstance(value, list) or not all(isinstance(word, str) for word in value):
        raise UserError(f"{file}: {key} must be a list of words, is {value!r:.60}")
    for word in value:
        if choices is not None:
            check_choice(file, key, word, choices)
    return tuple(value)


def check_choice(file: Path, key: str, word: Any, choices: Sequence[str]) -> None:
    """One of the choices."""
    if word not in choices:
        raise UserError(f"{file}: {key}: '{word}' is not known, {nearest(str(word), choices)}")


def check_number(file: Path, key: str, value: Any) -> None:
    """A number, and no boolean."""
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise UserError(f"{file}: {key} must be a number, is {value!r:.60}")


def check_keys(file: Path, where: str, tree: Any, known: set[str]) -> dict[str, Any]:
    """A mapping with no other keys than the known ones."""
    if not isinstance(tree, dict):
        raise UserError(f"{file}: {where or 'a suite'} must map keys to values, is {tree!r:.60}")
    for key in tree:
        if key not in known:
            full = f"{where}.{key}" if where else str(key)
            raise UserError(f"{file}: unknown key '{full}', {nearest(str(key), known)}")
    return tree


def check_name(file: Path, key: str, name: Any) -> None:
    """Names become folders."""
    if not isinstance(name, str) or not re.fullmatch(r"[\w.+-]+", name) or name.startswith("."):
        raise UserError(f"{file}: {key}: {name!r:.60} cannot name a folder; use letters, digits, '_', '-', '+' and '.'")
