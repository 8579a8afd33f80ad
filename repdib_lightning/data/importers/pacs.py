"""PACS, and any folder of its shape: pictures by domain (how they are drawn) and class (what they show).

PACS: Li, Yang, Song, Hospedales, Deeper, broader and artier domain generalization, ICCV 2017.

::

    SOURCE/<domain>/<class>/*.jpg, *.jpeg or *.png
    SPLITS/<domain>_{train,crossval}_kfold.txt        optional, the official lists
"""

from __future__ import annotations

import sys
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

from repdib_lightning.data.importers.combinations import notes_on_combinations
from repdib_lightning.data.importers.picture_folders import Picture, find_pictures
from repdib_lightning.data.importers.picture_splits import choose_held_out, read_split
from repdib_lightning.data.importers.square_picture import read_square
from repdib_lightning.data.schema import FactorSpec
from repdib_lightning.data.writer import EpisodeWriter
from repdib_lightning.errors import UserError, nearest
from repdib_lightning.records import ArraySpec

_DAMAGED = "sketch/dog/n02103406_4068-1.png"


@dataclass(frozen=True)
class _Factor:
    """A factor: its name, its classes in the order of the alphabet, (N,) int64 the class of each picture."""

    name: str
    classes: list[str]
    values: np.ndarray


@dataclass(frozen=True)
class _Selection:
    """Which pictures are written.

    Attributes:
        pictures: in the order of the rows.
        evaluation: keys of those that are held out.
        unlisted: keys of pictures that are left out because no list of the split names them.
    """

    pictures: list[Picture]
    evaluation: set[str]
    unlisted: list[str]


def import_pacs(
    source: Path,
    output: Path,
    *,
    domains: str = "cartoon",
    classes: str = "elephant",
    factors: str = "domain,class",
    splits: Path | None = None,
    held_out: float = 0.2,
    leave_out: str = "",
    size: int = 64,
    seed: int = 0,
    environment: str = "pacs",
    licence: str = "unknown",
    overwrite: bool = False,
    progress: bool = True,
) -> Path:
    """Convert a folder of pictures by domain and class into a store, each picture an episode of one row.

    Observation ``pixels``, (3, size, size) uint8: the middle square of a picture, resized (bilinear, antialiased). What
    is transparent is laid on white; grey and palette pictures become RGB. There are no actions.

    Args:
        source: holds a folder for each domain, and that one for each class; names that begin with a dot or an
            underscore are passed over.
        output: the store to write (.h5).
        domains: folders to read, comma-separated, or ``all``; by default those of the paper's demonstration.
        classes: folders to read in each of them, comma-separated, or ``all``.
        factors: what domain and class are called in the store, comma-separated. Both are endogenous and categorical,
            numbered in the order of the alphabet. One that has a single value is left out.
        splits: folder of the official lists; those of ``crossval`` are held out, and pictures that no list names are
            left out. ``held_out`` and ``seed`` are not used then.
        held_out: share of the pictures marked for evaluation: as many of each domain as of any other, of its classes
            in proportion. 0 marks none, and a reader then takes every fifth.
        leave_out: pictures not to read, comma-separated, as DOMAIN/CLASS/NAME; a damaged one, for instance.
        size: height and width in pixels.
        seed: of the choice of what is held out.
        environment: where the data come from, for the record.
        licence: the terms of the data, for the record.
        overwrite: replace an existing output.
        progress: show a progress bar on a terminal.

    Returns:
        The output.

    Raises:
        UserError: naming file or folder, and line: another layout, a name that is not there, a picture that is
            unreadable or has more than 8 bits a channel, a list that is missing or wrong. No output is left.
    """
    source, output = Path(source), Path(output)
    names = _factor_names(factors)
    if size < 1 or seed < 0 or not 0 <= held_out < 1:
        raise UserError(
            f"size must be at least 1, seed at least 0, held_out in [0, 1), got {size}, {seed} and {held_out}"
        )
    found = find_pictures(source, domains, classes)
    selection = _select(source, found, leave_out=leave_out, splits=splits, held_out=held_out, seed=seed)
    attributes = {
        "environment": environment,
        "licence": licence,
        "source": str(source),
        "seed": seed,
        "configuration": {
            "domains": domains,
            "classes": classes,
            "splits": None if splits is None else str(splits),
            "held_out": held_out,
            "leave_out": leave_out,
            "size": size,
        },
    }
    varying = _varying(selection.pictures, names)
    modes = _write(selection, varying, output, attributes, size=size, overwrite=overwrite, progress=progress)
    combinations = notes_on_combinations(selection.pictures, names)
    for line in (*_unlisted(selection.unlisted), *combinations, *_converted(modes)):
        print(f"{source}: {line}", file=sys.stderr)
    return output


def _factor_names(factors: str) -> tuple[str, str]:
    names = [name.strip() for name in factors.split(",")]
    if len(names) != 2 or names[0] == names[1] or any(name in ("", ".") or "/" in name for name in names):
        raise UserError(f"factors='{factors}': expected two different names without '/', such as domain,class")
    return names[0], names[1]


def _select(
    source: Path, found: Sequence[Picture], *, leave_out: str, splits: Path | None, held_out: float, seed: int
) -> _Selection:
    """Of the pictures found, those to write: without the ones left out, and as the lists or the share say."""
    excluded = {word.strip() for word in leave_out.split(",")} - {""}
    pictures = [picture for picture in found if picture.key not in excluded]
    listed = None if splits is None else read_split(Path(splits), pictures, excluded)
    _check_left_out(source, excluded, {picture.key for picture in found}, listed or {})
    if listed is None:
        selection = _Selection(pictures, choose_held_out(pictures, held_out, seed), [])
    else:
        selection = _Selection(
            [picture for picture in pictures if picture.key in listed],
            {key for key, for_evaluation in listed.items() if for_evaluation},
            [picture.key for picture in pictures if picture.key not in listed],
        )
    if not selection.pictures:
        raise UserError(f"{source}: no picture remains, with leave_out='{leave_out}' and splits={splits}")
    return selection


def _varying(pictures: Sequence[Picture], names: tuple[str, str]) -> list[_Factor]:
    """Domain and class by the names given, where there are several."""
    factors = []
    columns = [picture.domain for picture in pictures], [picture.label for picture in pictures]
    for name, folders in zip(names, columns, strict=True):
        classes, values = np.unique(np.array(folders), return_inverse=True)
        if len(classes) > 1:
            factors.append(_Factor(name, classes.tolist(), values.reshape(-1)))
    return factors


def _check_left_out(source: Path, excluded: set[str], found: set[str], listed: Iterable[str]) -> None:
    """Refuse what names no picture; one that was deleted may still stand in a list."""
    for key in sorted(excluded - found - set(listed)):
        if not (source / key).is_file():
            near = {name for name in found if name.startswith(f"{key.rpartition('/')[0]}/")} or found
            raise UserError(f"leave_out: there is no picture '{key}' in {source}, {nearest(key, near)}")


def _unlisted(keys: Sequence[str]) -> list[str]:
    shown = ", ".join(keys[:3]) + (", ..." if len(keys) > 3 else "")
    return [f"in no list of the split, not imported: {len(keys)} ({shown})"] if keys else []


def _converted(modes: Counter[str]) -> list[str]:
    shown = ", ".join(f"{count} {mode}" for mode, count in sorted(modes.items()) if mode != "RGB")
    return [f"converted to RGB: {shown}"] if shown else []


def _write(
    selection: _Selection,
    factors: Sequence[_Factor],
    output: Path,
    attributes: dict[str, Any],
    *,
    size: int,
    overwrite: bool,
    progress: bool,
) -> Counter[str]:
    """Write the store, picture by picture; returns how many files held their picture in which mode."""
    pictures = selection.pictures
    if factors:
        attributes = {**attributes, "classes": {factor.name: factor.classes for factor in factors}}
    modes: Counter[str] = Counter()
    writer = EpisodeWriter(
        output,
        rows=len(pictures),
        episodes=len(pictures),
        observations={"pixels": ArraySpec((3, size, size))},
        actions=None,
        factors={factor.name: FactorSpec("endogenous", "categorical", len(factor.classes)) for factor in factors},
        attributes=attributes,
        overwrite=overwrite,
    )
    with writer, tqdm(total=len(pictures), desc="import", unit="picture", disable=None if progress else True) as bar:
        for row, picture in enumerate(pictures):
            pixels, mode = _read(picture, size)
            modes[mode] += 1
            writer.add_episode(
                observations={"pixels": pixels[None]},
                factors={factor.name: factor.values[row : row + 1] for factor in factors},
                evaluation=picture.key in selection.evaluation,
            )
            bar.update()
    return modes


def _read(picture: Picture, size: int) -> tuple[np.ndarray, str]:
    try:
        return read_square(picture.file, size)
    except UserError as error:
        known = "it is damaged in the published archive; " if picture.key == _DAMAGED else ""
        raise UserError(f"{error}; {known}pass --leave_out {picture.key} to go without it") from error
