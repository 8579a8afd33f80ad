"""V-D4RL at 64 px: one compressed npz file for each episode, named ``{time}-{id}-{length}.npz``.

Keys: image (T, H, W, 3) uint8, action (T, A), reward (T,), discount (T,), is_first, is_last, is_terminal (T,) bool;
T = 501 as published. The three flags are checked where they are present.
"""

from __future__ import annotations

import re
import zipfile
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

from repdib_lightning.data.importers.recorded import (
    RecordedEpisode,
    RecordedShape,
    check_early_end,
    check_finite,
    check_image,
    numbers,
)
from repdib_lightning.errors import UserError

_KEYS = ("image", "action", "reward", "discount")
_DAMAGE = (OSError, ValueError, EOFError, KeyError, zipfile.BadZipFile, zlib.error)


class EpisodeFiles:
    """Episodes in the order of their files. All but the pictures is read and checked at once, in a first pass.

    Args:
        files: npz files, one for each episode.
        progress: show a progress bar over the first pass.

    Raises:
        UserError: naming file and key.
    """

    def __init__(self, files: list[Path], *, progress: bool = False) -> None:
        self._files = files
        rows = 0
        for file in tqdm(files, desc="check", unit="file", disable=not progress):
            image, action_size = _check_file(file)
            found = ((image[3], image[1], image[2]), action_size)
            if rows == 0:
                expected = found
            if found != expected:
                raise UserError(
                    f"{file}: pictures (C, H, W) and action width are {found}, {files[0].name} has {expected}"
                )
            rows += image[0]
        self.shape = RecordedShape(len(files), rows, *expected)

    def episodes(self) -> Iterator[RecordedEpisode]:
        """One episode a file."""
        for file in self._files:
            with _open(file) as archive:
                images = _read(file, archive, "image")
                vectors = _read_vectors(file, archive, len(images))
            yield RecordedEpisode(np.ascontiguousarray(images.transpose(0, 3, 1, 2)), *vectors)


def _open(file: Path) -> Any:
    try:
        archive = np.load(file, allow_pickle=False)
    except _DAMAGE as error:
        raise UserError(f"{file}: not a readable npz file ({str(error).splitlines()[0]})") from error
    if not isinstance(archive, np.lib.npyio.NpzFile):
        raise UserError(f"{file}: not a readable npz file (a single array, not an archive of arrays)")
    return archive


def _read(file: Path, archive: Any, key: str) -> np.ndarray:
    try:
        array: np.ndarray = archive[key]
    except _DAMAGE as error:
        raise UserError(f"{file}: '{key}' cannot be read ({str(error).splitlines()[0]})") from error
    return array


def _check_file(file: Path) -> tuple[tuple[int, ...], int]:
    """Check one file without decoding its pictures: their shape (T, H, W, C), and A."""
    with _open(file) as archive:
        for key in _KEYS:
            if key not in archive.files:
                raise UserError(f"{file}: key '{key}' is missing (it holds: {', '.join(archive.files) or 'nothing'})")
        shape, dtype = _image_header(file, archive)
        check_image(file, "image", shape, dtype, channels_axis=3)
        if shape[0] < 2:
            raise UserError(f"{file}: an episode of {shape[0]} row(s) holds no action")
        named = re.search(r"-(\d+)$", file.stem)
        if named and int(named[1]) not in (shape[0], shape[0] - 1):
            raise UserError(f"{file}: 'image' has {shape[0]} rows, the file name says {named[1]}")
        actions, rewards, discounts = _read_vectors(file, archive, shape[0])
        check_finite(file, 0, {"action": actions, "reward": rewards, "discount": discounts})
        check_early_end(file, 0, discounts)
        _check_flags(file, archive, shape[0])
    return shape, actions.shape[1]


def _image_header(file: Path, archive: Any) -> tuple[tuple[int, ...], np.dtype[Any]]:
    try:
        with archive.zip.open("image.npy") as stream:
            version = np.lib.format.read_magic(stream)
            read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
            shape, _, dtype = read(stream)
    except _DAMAGE as error:
        raise UserError(f"{file}: 'image' cannot be read ({str(error).splitlines()[0]})") from error
    return shape, dtype


def _read_vectors(file: Path, archive: Any, rows: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Actions (T, A), rewards (T,) and discounts (T,), whose last one is 0 where the episode terminated."""
    actions = numbers(file, "action", _read(file, archive, "action"), rows, width=True)
    rewards = numbers(file, "reward", _read(file, archive, "reward"), rows)
    discounts = numbers(file, "discount", _read(file, archive, "discount"), rows)
    if "is_terminal" in archive.files:
        terminal = numbers(file, "is_terminal", _read(file, archive, "is_terminal"), rows)
        discounts = np.where(terminal > 0, np.float32(0), discounts)
    return actions, rewards, discounts


def _check_flags(file: Path, archive: Any, rows: int) -> None:
    """A first row elsewhere than at the start, or a last one before the end, means several episodes in one file."""
    for key, place in (("is_first", 0), ("is_last", rows - 1)):
        if key in archive.files:
            flags = numbers(file, key, _read(file, archive, key), rows)
            wrong = np.flatnonzero((flags > 0) & (np.arange(rows) != place))
            if len(wrong):
                raise UserError(f"{file}: '{key}' is set at row {wrong[0]}; one file must hold one episode")
