"""Which pictures of a folder are held out: those of published lists, or a balanced choice."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from repdib_lightning.data.importers.picture_folders import Picture
from repdib_lightning.errors import UserError, nearest

_PARTS = {"train": False, "crossval": True}


@dataclass(frozen=True)
class _Entry:
    """One line of a list."""

    file: Path
    line: int
    key: str
    number: int
    held_out: bool

    @property
    def place(self) -> str:
        return f"{self.file}: line {self.line}"

    @property
    def label(self) -> str:
        return self.key.split("/")[1]


def read_split(folder: Path, pictures: Sequence[Picture], leave_out: set[str]) -> dict[str, bool]:
    """Official lists: ``<domain>_train_kfold.txt`` and ``<domain>_crossval_kfold.txt``, the latter held out.

    Their lines are ``cartoon/elephant/pic_001.jpg 2``: the picture, and the number of its class, in the order of the
    alphabet from 1. Lines of classes that are not imported are checked, but need no picture.

    Args:
        folder: holds the lists.
        pictures: what is imported.
        leave_out: keys of pictures that a list may name without their being there.

    Returns:
        key of a picture -> whether it is held out; also of those in ``leave_out`` that stand in a list.

    Raises:
        UserError: naming file and line: a list that is missing, a line that is no such line, a wrong number, a picture
            that is not there or is named twice.
    """
    if not folder.is_dir():
        raise UserError(f"splits: {folder}: no such folder")
    domains, labels = {picture.domain for picture in pictures}, {picture.label for picture in pictures}
    entries = [
        entry
        for domain in sorted(domains)
        for part, held_out in _PARTS.items()
        for entry in _read_list(folder, domain, part, held_out)
    ]
    _check_numbers(entries, labels)
    there = {picture.key for picture in pictures} | leave_out
    found: dict[str, bool] = {}
    for entry in entries:
        if entry.key in found:
            raise UserError(f"{entry.place}: '{entry.key}' is listed for the second time")
        if entry.label not in labels and entry.key not in leave_out:
            continue
        if entry.key not in there:
            raise UserError(
                f"{entry.place}: there is no picture '{entry.key}'; pass --leave_out {entry.key} to go without it"
            )
        found[entry.key] = entry.held_out
    return found


def _read_list(folder: Path, domain: str, part: str, held_out: bool) -> list[_Entry]:
    file = folder / f"{domain}_{part}_kfold.txt"
    try:
        lines = file.read_text(encoding="utf-8").splitlines()
    except FileNotFoundError as error:
        there = [path.name for path in folder.glob("*_kfold.txt")]
        raise UserError(f"{file}: no such list of a split, {nearest(file.name, there)}".rstrip(", ")) from error
    except (OSError, UnicodeDecodeError) as error:
        raise UserError(f"{file}: not a readable list ({getattr(error, 'strerror', None) or error})") from error
    return [_parse(file, number, line, domain, held_out) for number, line in enumerate(lines, start=1) if line.strip()]


def _parse(file: Path, line: int, text: str, domain: str, held_out: bool) -> _Entry:
    key, _, number = text.strip().rpartition(" ")
    parts = key.strip().split("/")
    if len(parts) != 3 or not all(parts) or parts[0] != domain or not (number.isascii() and number.isdigit()):
        raise UserError(f"{file}: line {line}: '{text.strip()}'; expected '{domain}/CLASS/PICTURE NUMBER'")
    return _Entry(file, line, key.strip(), int(number), held_out)


def _check_numbers(entries: list[_Entry], labels: set[str]) -> None:
    names = sorted(labels | {entry.label for entry in entries})
    for entry in entries:
        right = names.index(entry.label) + 1
        if entry.number != right:
            raise UserError(
                f"{entry.place}: gives '{entry.label}' the number {entry.number}; in the order of the alphabet "
                f"({', '.join(names)}) it is {right}"
            )


def choose_held_out(pictures: Sequence[Picture], share: float, seed: int) -> set[str]:
    """Choose pictures to hold out, evenly over domains and then over classes.

    One picture after another is taken from the domain with the fewest held out, and in it from the class of which the
    smallest share is held out in this domain, then over all domains. A domain's or class's last picture in training is
    taken only where nothing else is left. So, unless a domain runs out, the counts held out of the domains differ by
    at most one, whatever their sizes; where each combination has one picture, combinations are held out.

    Args:
        pictures: all there are.
        share: of the pictures, in [0, 1); where it is not 0, at least one is held out, and at least one is not.
        seed: of the choice among equals.

    Returns:
        Their keys.
    """
    wanted = min(max(1, round(share * len(pictures))), len(pictures) - 1) if share else 0
    domains = {name: index for index, name in enumerate(sorted({picture.domain for picture in pictures}))}
    labels = {name: index for index, name in enumerate(sorted({picture.label for picture in pictures}))}
    random = np.random.default_rng(seed)
    cells: dict[tuple[int, int], list[str]] = {}
    for index in random.permutation(len(pictures)):
        picture = pictures[index]
        cells.setdefault((domains[picture.domain], labels[picture.label]), []).append(picture.key)
    sizes = np.zeros((len(domains), len(labels)), np.int64)
    for cell, keys in cells.items():
        sizes[cell] = len(keys)
    taken = np.zeros_like(sizes)
    order = random.permutation(sizes.size).reshape(sizes.shape)
    chosen = set()
    for _ in range(wanted):
        cell = _next_cell(sizes, taken, order)
        chosen.add(cells[cell][taken[cell]])
        taken[cell] += 1
    return chosen


def _next_cell(sizes: np.ndarray, taken: np.ndarray, order: np.ndarray) -> tuple[int, int]:
    """The cell to take the next picture from: (domains, classes) each."""
    of_domain, of_class = taken.sum(1, keepdims=True), taken.sum(0, keepdims=True)
    empties_domain = sizes.sum(1, keepdims=True) - of_domain == 1
    empties_class = sizes.sum(0, keepdims=True) - of_class == 1
    allowed = taken < sizes
    preferences = (
        empties_domain + empties_class.astype(np.int64),
        of_domain,
        (taken + 1) / np.maximum(sizes, 1),
        (of_class + 1) / sizes.sum(0, keepdims=True),
        order,
    )
    for values in preferences:
        spread = np.broadcast_to(values, sizes.shape)
        allowed = allowed & (spread == spread[allowed].min())
    ((domain, label),) = np.argwhere(allowed)
    return int(domain), int(label)
