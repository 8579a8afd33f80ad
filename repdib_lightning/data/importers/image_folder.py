"""A folder of images with a CSV, one row a time step: the layout of the published robot-arm recordings.

::

    SOURCE/run.csv        image,action,cell,time        (or one column of file names for each camera)
    SOURCE/images/...     the files that the CSV names, relative to SOURCE or to SOURCE/images
"""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from PIL import Image
from tqdm import tqdm

from repdib_lightning.data.importers.image_columns import ColumnChoice, choose_columns
from repdib_lightning.data.importers.image_table import Actions, Table, parse_actions, parse_factor, read_table
from repdib_lightning.data.schema import FactorSpec
from repdib_lightning.data.writer import EpisodeWriter
from repdib_lightning.errors import UserError, nearest
from repdib_lightning.records import ArraySpec


def import_images(
    source: Path,
    output: Path,
    *,
    table: str | None = None,
    image_columns: str | None = None,
    action_column: str | None = None,
    action_timing: Literal["at", "before"] = "at",
    action_kind: Literal["discrete", "continuous"] | None = None,
    factor_columns: str | None = None,
    episode_column: str | None = None,
    episode_length: int = 500,
    time_column: str | None = None,
    size: int | None = None,
    environment: str = "unknown",
    licence: str = "unknown",
    overwrite: bool = False,
    progress: bool = True,
) -> Path:
    """Convert a folder of images and a CSV, rows in the order of time, into a store.

    What a row's action means: where a step is recorded as *before-image, command, after-image, row*, the row with the
    before-image has ``action_timing`` ``at`` (the action was taken at this image; the default), a row with the
    after-image has ``before`` (the action led to this image). If the CSV names both, the before-images are read.

    Args:
        source: the folder, or the CSV in it.
        output: the store to write (.h5).
        table: file name of the CSV, where the folder holds several and none is called run.csv.
        image_columns: columns of file names, comma-separated, each as COLUMN or NAME=COLUMN; recognised by the endings.
        action_column: the action's column, or several comma-separated ones for a vector; ``none`` for no actions.
            Texts become integers in alphabetical order; integers stay; several columns or fractions are continuous.
        action_timing: whether a row's action was taken at its image, or led to it.
        action_kind: overrules the choice between discrete and continuous.
        factor_columns: ground truth as COLUMN:endogenous or COLUMN:exogenous, comma-separated, with :categorical or
            :continuous after it to overrule; by default, columns called cell or state, and time or step.
        episode_column: rows of one episode share its value; without one, an episode is episode_length rows.
        episode_length: rows of an episode where no column tells.
        time_column: must not decrease within an episode; ``none`` to leave that unchecked.
        size: height and width in pixels to resize to (bilinear, antialiased); default: as the files are.
        environment: where the data come from, for the record.
        licence: the terms of the data, for the record.
        overwrite: replace an existing output.
        progress: show a progress bar, and a line that says which columns were read.

    Returns:
        The output.

    Raises:
        UserError: naming file, column and line; no output is left.
    """
    source, output = Path(source), Path(output)
    if episode_length < 2 or (size is not None and size < 1):
        raise UserError(f"episode_length must be at least 2 and size at least 1, got {episode_length} and {size}")
    data = read_table(_find_table(source, table))
    columns = choose_columns(
        data,
        image_columns=image_columns,
        action_column=action_column,
        factor_columns=factor_columns,
        episode_column=episode_column,
        time_column=time_column,
    )
    recording = _Recording(data, columns, size=size, episode_length=episode_length)
    recording.read_actions(action_timing, action_kind)
    if progress:
        tqdm.write(recording.summary(), file=sys.stderr)
    attributes = {"environment": environment, "licence": licence, "source": str(data.path)}
    return _write(recording, output, attributes, overwrite=overwrite, progress=progress)


def _find_table(source: Path, table: str | None) -> Path:
    if source.is_file():
        return source
    if not source.is_dir():
        raise UserError(f"{source}: no such folder or CSV file")
    found = sorted(file.name for file in source.glob("*.csv"))
    if table is not None:
        if table not in found:
            raise UserError(f"{source / table}: no such CSV file, {nearest(table, found)}".rstrip(", "))
        return source / table
    if "run.csv" in found or len(found) == 1:
        return source / ("run.csv" if "run.csv" in found else found[0])
    if found:
        raise UserError(f"{source}: holds several CSV files ({', '.join(found)}); pass --table")
    raise UserError(f"{source}: holds no CSV file (expected: run.csv beside images/)")


@dataclass(frozen=True)
class _Camera:
    """One column of pictures: N files, and the (C, H, W) that each must have."""

    files: list[Path]
    spec: ArraySpec


class _Recording:
    """Everything but the pictures, checked; the pictures are read episode by episode."""

    def __init__(self, table: Table, columns: ColumnChoice, *, size: int | None, episode_length: int) -> None:
        self.table, self.columns, self.size = table, columns, size
        self.bounds = _episode_bounds(table, columns.episode, episode_length)
        if max(stop - start for start, stop in self.bounds) < 2:
            raise UserError(f"{table.path}: no episode has two rows; pass another --episode_column, or none")
        _check_time(table, columns.time, self.bounds)
        self.cameras = {name: self._camera(column) for name, column in columns.images.items()}
        self.factors: dict[str, tuple[FactorSpec, np.ndarray]] = {}
        self.classes: dict[str, list[str]] = {}
        for name, (kind, scale) in columns.factors.items():
            spec, values, classes = parse_factor(table, name, kind, scale)
            self.factors[name.replace("/", "_")] = spec, values
            if classes is not None:
                self.classes[name] = classes
        self.actions: Actions | None = None
        self._action_shift = 0

    def read_actions(self, timing: str, kind: str | None) -> None:
        """Read the action columns; the one row of each episode whose action has no use may be blank."""
        if not self.columns.actions:
            return
        self._action_shift = 1 if timing == "before" else 0
        void = np.zeros(len(self.table), bool)
        void[[start if self._action_shift else stop - 1 for start, stop in self.bounds]] = True
        self.actions = parse_actions(self.table, self.columns.actions, void, kind)
        if self.actions.classes is not None:
            self.classes["actions"] = self.actions.classes

    def episode_actions(self, start: int, stop: int) -> np.ndarray | None:
        """(T - 1,) or (T - 1, A): the action taken at each image but the last."""
        if self.actions is None:
            return None
        return self.actions.values[start + self._action_shift : stop - 1 + self._action_shift]

    def summary(self) -> str:
        """One line: which column was read as what."""
        images = ", ".join(f"{name} from '{column}'" for name, column in self.columns.images.items())
        kind = "none" if self.actions is None else f"{self.actions.spec.kind} from {', '.join(self.columns.actions)}"
        factors = ", ".join(f"{name} ({kind})" for name, (kind, _) in self.columns.factors.items()) or "none"
        ignored = ", ".join(self.columns.unused(self.table)) or "none"
        return (
            f"{self.table.path}: {len(self.table)} rows, {len(self.bounds)} episodes; images: {images}; "
            f"actions: {kind}; factors: {factors}; columns not read: {ignored}"
        )

    def _camera(self, column: str) -> _Camera:
        folders = (self.table.path.parent, self.table.path.parent / "images")
        files = []
        for line, text in zip(self.table.lines, self.table.columns[column], strict=True):
            file = next((folder / text for folder in folders if text and (folder / text).is_file()), None)
            if file is None:
                raise UserError(f"{self.table.path}: line {line}, column '{column}': no such image file '{text}'")
            files.append(file)
        return _Camera(files, ArraySpec(_read_image(files[0], self.size).shape))

    def pictures(self, camera: _Camera, start: int, stop: int) -> np.ndarray:
        """(T, 3, H, W) uint8."""
        images = np.empty((stop - start, *camera.spec.shape), np.uint8)
        for row in range(start, stop):
            image = _read_image(camera.files[row], self.size)
            if image.shape != camera.spec.shape:
                (_, height, width), (_, first_height, first_width) = image.shape, camera.spec.shape
                raise UserError(
                    f"{camera.files[row]}: is {width} x {height} pixels, {camera.files[0].name} is "
                    f"{first_width} x {first_height}; pass --size to resize all"
                )
            images[row - start] = image
        return images


def _episode_bounds(table: Table, column: str | None, length: int) -> list[tuple[int, int]]:
    """Row ranges [start, stop) of the episodes."""
    rows = len(table)
    if column is None:
        starts = list(range(0, rows, length))
        if len(starts) > 1 and rows - starts[-1] == 1:
            starts.pop()  # one row alone holds no action: it ends the episode before it
    else:
        names = table.columns[column]
        starts = [row for row in range(rows) if row == 0 or names[row] != names[row - 1]]
        seen: set[str] = set()
        for row in starts:
            if names[row] in seen:
                raise UserError(
                    f"{table.path}: column '{column}': episode '{names[row]}' starts again at line {table.lines[row]}; "
                    "rows of one episode must stand together"
                )
            seen.add(names[row])
    return list(zip(starts, [*starts[1:], rows], strict=True))


def _check_time(table: Table, column: str | None, bounds: list[tuple[int, int]]) -> None:
    if column is None or not table.is_number(column):
        return
    times = np.array([float(text or "nan") for text in table.columns[column]])
    for start, stop in bounds:
        back = np.flatnonzero(np.diff(times[start:stop]) < 0)
        if len(back):
            line = table.lines[start + int(back[0]) + 1]
            raise UserError(
                f"{table.path}: column '{column}' goes back in time at line {line}; sort the rows, name the "
                "--episode_column, or pass --time_column none"
            )


def _read_image(path: Path, size: int | None) -> np.ndarray:
    """(3, H, W) uint8."""
    try:
        with Image.open(path) as file:
            if file.mode.startswith(("I", "F")):
                raise UserError(f"{path}: has more than 8 bits a channel (mode {file.mode}); convert it to 8 bits")
            image = file.convert("RGB")
            if size is not None:
                image = image.resize((size, size), Image.Resampling.BILINEAR)
            return np.ascontiguousarray(np.asarray(image).transpose(2, 0, 1))
    except (OSError, SyntaxError, Image.DecompressionBombError) as error:
        raise UserError(f"{path}: not a readable image ({str(error).splitlines()[0]})") from error


def _write(recording: _Recording, output: Path, attributes: dict[str, Any], *, overwrite: bool, progress: bool) -> Path:
    if recording.classes:
        attributes |= {"classes": recording.classes}
    writer = EpisodeWriter(
        output,
        rows=len(recording.table),
        episodes=len(recording.bounds),
        observations={name: camera.spec for name, camera in recording.cameras.items()},
        actions=None if recording.actions is None else recording.actions.spec,
        factors={name: spec for name, (spec, _) in recording.factors.items()},
        attributes=attributes,
        overwrite=overwrite,
    )
    with writer, tqdm(total=len(recording.table), desc="import", unit="row", disable=not progress) as bar:
        for start, stop in recording.bounds:
            writer.add_episode(
                observations={
                    name: recording.pictures(camera, start, stop) for name, camera in recording.cameras.items()
                },
                actions=recording.episode_actions(start, stop),
                factors={name: values[start:stop] for name, (_, values) in recording.factors.items()},
            )
            bar.update(stop - start)
    return output
