"""Writes a store episode by episode; the file appears only when it is complete."""

from __future__ import annotations

import glob
import os
from contextlib import suppress
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np

from repdib_lightning.data.episode_checks import (
    check_episode,
    check_recording,
    check_stated,
    columns_of,
    flat,
    plain_attributes,
)
from repdib_lightning.data.files import sync_directory
from repdib_lightning.data.fingerprint import ContentHash
from repdib_lightning.data.growing import GrowingArrays
from repdib_lightning.data.partial import open_partial, partial_of
from repdib_lightning.data.row_file import RowFile, make_empty
from repdib_lightning.data.schema import FactorSpec
from repdib_lightning.data.statement import Statement
from repdib_lightning.errors import UserError
from repdib_lightning.records import ActionSpec, ArraySpec

_REFUSED = (OSError, RuntimeError, ValueError, TypeError)  # by the disk, or by HDF5, such as a number of 70 bits


class EpisodeWriter:
    """Writes one store. The number of rows and episodes is stated first, so that every array is contiguous.

    Use as a context manager: leaving it normally publishes the file (flush, rename), leaving it by an error removes
    what was written.

    With ``resume`` it is kept instead, in ``.NAME.partial`` beside the file, and a writer with the same arguments goes
    on after the last whole episode, of which ``episodes_done`` tells: whatever ended the process, the finished file
    is byte for byte that of an uninterrupted recording. After a power cut, too, every episode that counts is whole.

    Args:
        path: the file to make; must not exist unless ``overwrite``.
        rows: N, over all episodes (final observations included).
        episodes: E.
        observations: name -> shape and dtype of one un-stacked observation.
        actions: kind and width; None for data without actions.
        factors: name -> what is known of each ground-truth factor.
        masks: observation name -> (H, W) of its agent mask.
        rewards: whether rewards, terminations and truncations are written.
        attributes: environment, generating configuration, seed, licence; plain values, nested ones become JSON.
        recordings: whether each episode states the recording that it was cut of.
        overwrite: replace an existing file; with ``resume``, discard an unfinished recording, too.
        resume: keep what an interruption leaves, and go on with it.
        keep: with ``resume``, go on after this many episodes and forget later ones; None keeps all.
        goes_on: with ``resume``, the command that goes on with an unfinished recording, told where one cannot be
            written further; None for the command that began it.

    Raises:
        UserError: the path exists or is a folder, cannot be written, the disk is full, or what is stated cannot be a
            store; with ``resume``: an unfinished recording is there that other arguments began (told which), that is
            damaged, or that another process is writing; on leaving: fewer rows or episodes than stated were added (no
            file appears then).
    """

    def __init__(
        self,
        path: str | Path,
        *,
        rows: int,
        episodes: int,
        observations: dict[str, ArraySpec],
        actions: ActionSpec | None,
        factors: dict[str, FactorSpec] | None = None,
        masks: dict[str, tuple[int, int]] | None = None,
        rewards: bool = False,
        attributes: dict[str, Any] | None = None,
        recordings: bool = False,
        overwrite: bool = False,
        resume: bool = False,
        keep: int | None = None,
        goes_on: str | None = None,
    ) -> None:
        assert keep is None or resume
        self.path = Path(path)
        if self.path.is_dir():
            raise UserError(f"{self.path}: is a folder; name a file, such as {self.path / 'NAME.h5'}")
        if self.path.exists() and not overwrite:
            raise UserError(f"{self.path}: exists already; choose another file or pass --overwrite")
        factors, masks = factors or {}, masks or {}
        check_stated(self.path, rows, episodes, observations, actions, factors, masks)
        plain = plain_attributes(self.path, attributes or {})
        self.rows, self.episodes = rows, episodes
        self.observations, self.actions = observations, actions
        self._columns = columns_of(observations, actions, factors, masks, rewards)
        self._resume, self._overwrite, self._recordings = resume, overwrite, recordings
        self._goes_on = goes_on or ("the same command without --overwrite" if overwrite else "the same command")
        self._row = self._episode = 0
        self._hash = ContentHash()
        self._temporary = self.path.with_name(f".{self.path.name}.tmp-{os.getpid()}")
        self._file: RowFile | None = None
        statement = Statement(rows, episodes, self._columns, actions, factors, masks, plain, recordings)
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            remove_leftovers(self.path)
            self._check_space(observations)
            self._file = self._open(statement)
            self._go_on(keep)
        except BaseException as error:
            self.close()
            if isinstance(error, _REFUSED) and not isinstance(error, UserError):
                raise self._cannot_write(error) from error
            raise

    @property
    def episodes_done(self) -> int:
        """How many episodes are written; with ``resume`` those of earlier, interrupted recordings count."""
        return self._episode

    def arrays(self) -> GrowingArrays:
        """What is written, as it grows."""
        assert self._file is not None
        return GrowingArrays(self._file, self._columns)

    def _open(self, statement: Statement) -> RowFile:
        if self._resume:
            return open_partial(self.path, statement, self._temporary, begin_anew=self._overwrite)
        make_empty(self._temporary, statement)
        return RowFile(self._temporary, os.open(self._temporary, os.O_RDWR))

    def _go_on(self, keep: int | None) -> None:
        """Hash the episodes that are there, one at a time."""
        assert self._file is not None
        if keep is not None:
            there = len(self._file.lengths())
            if there < keep:
                raise UserError(f"{partial_of(self.path)}: holds {there} episodes, {keep} are to be gone on with")
            self._file.forget_after(keep)
        for length in map(int, self._file.lengths()):
            rows = {key: self._file.read(key, self._row, length) for key in self._columns}
            evaluation = bool(self._file.read("episodes/evaluation", self._episode, 1)[0, 0])
            stated = self._file.read("episodes/recording", self._episode, 1) if self._recordings else None
            recording = None if stated is None else int(stated.view(np.int64)[0, 0])
            self._hash.add_episode(rows, evaluation=evaluation, recording=recording)
            self._row, self._episode = self._row + length, self._episode + 1

    def _check_space(self, observations: dict[str, ArraySpec]) -> None:
        width = {"uint8": 1, "float32": 4}
        needed = self.rows * sum(int(np.prod(s.shape)) * width[s.dtype] for s in observations.values())
        partial = partial_of(self.path)
        if self._resume and partial.is_file():
            needed -= partial.stat().st_blocks * 512
        status = os.statvfs(self.path.parent)
        if needed > status.f_bavail * status.f_frsize:
            free = status.f_bavail * status.f_frsize / 2**20
            raise UserError(f"{self.path}: cannot be written (needs {needed / 2**20:.0f} MiB, {free:.0f} MiB are free)")

    def _cannot_write(self, error: Exception) -> UserError:
        reason = f"{self.path}: cannot be written ({getattr(error, 'strerror', None) or error})"
        kept = self._resume and self._file is not None
        return UserError(f"{reason}; {self._kept()}" if kept else reason)

    def _kept(self) -> str:
        return f"{self._episode} of {self.episodes} episodes are kept, {self._goes_on} goes on after them"

    def add_episode(
        self,
        *,
        observations: dict[str, np.ndarray],
        actions: np.ndarray | None = None,
        rewards: np.ndarray | None = None,
        terminations: np.ndarray | None = None,
        truncations: np.ndarray | None = None,
        factors: dict[str, np.ndarray] | None = None,
        masks: dict[str, np.ndarray] | None = None,
        evaluation: bool = False,
        recording: int | None = None,
    ) -> None:
        """Append one episode of T rows.

        Args:
            observations: name -> (T, ...).
            actions: (T - 1,) or (T - 1, A); the final row gets the placeholder.
            rewards, terminations, truncations: (T - 1,); required where the writer was made with ``rewards``.
            factors: name -> (T, ...).
            masks: observation name -> (T, H, W) bool.
            evaluation: the episode is never trained on.
            recording: number of the recording that it was cut of; required where the writer was made with
                ``recordings``.

        Raises:
            UserError: an array that was stated is missing, one was not stated, or shape, type or values are not as
                stated (named with key and episode; nothing of the episode is written), the disk is full.
        """
        where = f"{self.path}: episode {self._episode}"
        if self._file is None:
            raise UserError(f"{where}: the writer is closed; add episodes inside its `with` block")
        if not isinstance(evaluation, (bool, np.bool_)):
            raise UserError(f"{where}: evaluation is {evaluation!r}; expected True or False")
        number = check_recording(where, recording, stated=self._recordings)
        groups = {"observations": observations, "factors": factors, "masks": masks}
        single = {"actions": actions, "rewards": rewards, "terminations": terminations, "truncations": truncations}
        arrays = check_episode(where, self._columns, flat(where, groups, single))
        length = len(next(iter(arrays.values())))
        rows = slice(self._row, self._row + length)
        if rows.stop > self.rows or self._episode >= self.episodes:
            stated = f"the writer was made for {self.rows} rows in {self.episodes} episodes"
            raise UserError(f"{where} ends at row {rows.stop}, but {stated}")
        content = self._hash.copy()
        content.add_episode(arrays, evaluation=bool(evaluation), recording=number)
        try:
            for key, array in arrays.items():
                self._file.write(key, rows.start, array)
            self._file.write("episodes/start", self._episode, np.array([rows.start]))
            self._file.write("episodes/evaluation", self._episode, np.array([bool(evaluation)]))
            if number is not None:
                self._file.write("episodes/recording", self._episode, np.array([number]))
            if self._resume:
                self._file.flush()  # nothing may say that rows are there before they are
            self._file.write("episodes/length", self._episode, np.array([length]))
        except OSError as error:
            raise self._cannot_write(error) from error
        self._hash, self._row, self._episode = content, rows.stop, self._episode + 1

    def __enter__(self) -> EpisodeWriter:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        try:
            if kind is None:
                self._publish()
        finally:
            self.close()

    def close(self) -> None:
        """Give the file back; what was written is kept with ``resume``, and gone without."""
        if self._file is not None:
            file, self._file = self._file, None
            if self._resume:
                with suppress(OSError):
                    file.flush()
            file.close()
        self._temporary.unlink(missing_ok=True)

    def _publish(self) -> None:
        assert self._file is not None
        if (self._row, self._episode) != (self.rows, self.episodes):
            kept = f"; {self._kept()}" if self._resume else ""
            raise UserError(
                f"{self.path}: not written, {self._row} rows in {self._episode} episodes were added, "
                f"{self.rows} rows in {self.episodes} episodes were stated{kept}"
            )
        try:
            self._file.flush()
            self._file.seal(self._hash.hexdigest())
            os.replace(self._file.path, self.path)
            sync_directory(self.path.parent)
        except OSError as error:
            raise self._cannot_write(error) from error


def remove_leftovers(path: Path) -> None:
    """Delete what processes that were killed while they wrote this file have left beside it."""
    for leftover in path.parent.glob(f".{glob.escape(path.name)}.tmp-*"):
        number = leftover.name.rpartition("-")[2]
        if number.isascii() and number.isdigit() and not _is_alive(int(number)):
            leftover.unlink(missing_ok=True)


def _is_alive(process: int) -> bool:
    try:
        os.kill(process, 0)
    except (ProcessLookupError, OverflowError):
        return False
    except PermissionError:  # it belongs to someone else
        return True
    return True
