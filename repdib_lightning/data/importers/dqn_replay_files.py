"""The folder ``replay_logs`` of one training run: which checkpoints are there, and what their small arrays hold.

Dopamine's replay memory is a ring. It was logged whenever one row was missing to the next round (and at the end of
training), so that the rows from the writing position on are of the round before: ``add_count`` tells where that is.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from repdib_lightning.data.importers.dqn_replay_arrays import ArrayStream
from repdib_lightning.errors import UserError
from repdib_lightning.word_lists import in_ranges

FOLDER = "replay_logs"
ARRAYS = ("observation", "action", "reward", "terminal")

_NAME = re.compile(r"\$store\$_(?:observation|action|reward|terminal)_ckpt\.(\d+)\.gz")
_KINDS = {"action": "iu", "reward": "f", "terminal": "iub"}
_WORDS = {"action": "whole numbers", "reward": "floating point", "terminal": "whole numbers"}
_LEVELS = 3


@dataclass(frozen=True)
class Steps:
    """One checkpoint without its frames, rows in the order in which they were played: n rows.

    Attributes:
        actions: (n,) whole numbers.
        rewards: (n,) float32.
        terminals: (n,) bool, the action ended the episode.
        size: height and width of the frames.
        older: rows behind these that are of an earlier round of the memory, and are not read.
    """

    actions: np.ndarray
    rewards: np.ndarray
    terminals: np.ndarray
    size: int
    older: int

    def __len__(self) -> int:
        return len(self.actions)


class ReplayLogs:
    """The checkpoints of one run.

    Args:
        source: the folder ``replay_logs``, or the one that holds it.

    Attributes:
        folder: the folder ``replay_logs``.
        numbers: of the checkpoints that have any array, in numeric order.

    Raises:
        UserError: there is none (names the nearest folder below that has one), or nothing is in it.
    """

    def __init__(self, source: Path) -> None:
        self.folder = _find_folder(Path(source))
        found = (_NAME.fullmatch(file.name) for file in self.folder.iterdir())
        self.numbers = sorted({int(name[1]) for name in found if name})

    @property
    def game(self) -> str:
        """The game as the published tree shows it: ``<Game>/<run>/replay_logs``."""
        return self.folder.absolute().parent.parent.name

    def path(self, array: str, number: int) -> Path:
        """The file of an array of a checkpoint."""
        return self.folder / f"$store$_{array}_ckpt.{number}.gz"

    def chosen(self, numbers: list[int] | None) -> list[int]:
        """Checkpoints to read, in numeric order: these, or all that are there; each has all its arrays.

        Raises:
            UserError: naming a checkpoint that is not there, or an array of one.
        """
        chosen = self.numbers if numbers is None else sorted(set(numbers))
        if not chosen:
            raise UserError(f"checkpoints={numbers}: name at least one; there are {in_ranges(self.numbers)}")
        for number in chosen:
            if number not in self.numbers:
                raise UserError(f"checkpoints={number}: is not in {self.folder}; there are {in_ranges(self.numbers)}")
            for array in ARRAYS:
                file = self.path(array, number)
                if not file.is_file():
                    told = f"is missing, the {array}s of checkpoint {number}"
                    raise UserError(f"{file}: {told}; get it, or choose other --checkpoints")
        return chosen

    def frames(self, number: int) -> ArrayStream:
        """The frames of a checkpoint, (n, size, size) uint8, from the first one on.

        Raises:
            UserError: naming the file: unreadable, or not of that form.
        """
        stream = ArrayStream(self.path("observation", number))
        shape, square = stream.shape, len(stream.shape) == 3 and stream.shape[1] == stream.shape[2]
        if stream.dtype != np.uint8 or not square:
            stream.close()
            told = f"is {stream.dtype} of shape {shape}" if stream.dtype != np.uint8 else f"has shape {shape}"
            raise UserError(f"{stream.path}: {told}, must be uint8 of shape (n, 84, 84), un-stacked frames")
        return stream

    def steps(self, number: int) -> Steps:
        """Actions, rewards and ends of a checkpoint.

        Raises:
            UserError: naming the file: unreadable, of another type or shape, lengths that disagree, an end that is
                neither 0 nor 1.
        """
        with self.frames(number) as frames:
            length, size = frames.shape[:2]
        vectors = {array: self._vector(array, number, length) for array in ARRAYS[1:]}
        played = self._played(number, length)
        ends = vectors["terminal"][:played]
        wrong = np.flatnonzero((ends != 0) & (ends != 1))
        if len(wrong):
            raise UserError(f"{self.path('terminal', number)}: is {ends[wrong[0]]} at row {wrong[0]:,}, must be 0 or 1")
        rewards = vectors["reward"][:played].astype(np.float32, copy=False)
        return Steps(vectors["action"][:played], rewards, ends.astype(bool), size, length - played)

    def _vector(self, array: str, number: int, length: int) -> np.ndarray:
        with ArrayStream(self.path(array, number)) as stream:
            if stream.dtype.kind not in _KINDS[array]:
                raise UserError(f"{stream.path}: is {stream.dtype}, must be {_WORDS[array]}")
            if len(stream.shape) != 1:
                raise UserError(f"{stream.path}: has shape {stream.shape}, must be (n,)")
            if stream.shape[0] != length:
                there = self.path("observation", number).name
                raise UserError(f"{stream.path}: has {stream.shape[0]:,} rows, {there} has {length:,}")
            return stream.read_all()

    def _played(self, number: int, length: int) -> int:
        """How many rows from the first on are of the round that the checkpoint logs; all without ``add_count``."""
        path = self.folder / f"add_count_ckpt.{number}.gz"
        if not path.is_file():
            return length
        with ArrayStream(path) as stream:
            if stream.dtype.kind not in "iu" or stream.shape not in ((), (1,)):
                raise UserError(f"{path}: is {stream.dtype} of shape {stream.shape}, must be one whole number")
            added = int(stream.read_all().reshape(-1)[0])
        return added % length or length if length else 0


def _find_folder(source: Path) -> Path:
    if not source.exists():
        raise UserError(f"{source}: no such file or folder")
    if source.is_file():
        raise UserError(f"{source}: is a file; name its folder, {source.parent}")
    for folder in (source, source / FOLDER):
        if folder.is_dir() and any(_NAME.fullmatch(file.name) for file in folder.iterdir()):
            return folder
    for level in range(1, _LEVELS + 1):
        below = sorted(folder for folder in source.glob("/".join(["*"] * level + [FOLDER])) if folder.is_dir())
        if below:
            raise UserError(f"{source}: holds no folder {FOLDER}; did you mean {below[0]}?")
    if source.name == FOLDER or (source / FOLDER).is_dir():
        raise UserError(f"{source}: holds no $store$_observation_ckpt.N.gz, and no other array of a replay memory")
    raise UserError(f"{source}: holds no folder {FOLDER}, expected <Game>/<run>/{FOLDER}")
