"""Keeps a run's status file up to date, and turns signals into exit codes."""

from __future__ import annotations

import sys
import time
from pathlib import Path
from typing import Any

import lightning.pytorch as pl
from lightning.pytorch.callbacks import Callback
from lightning.pytorch.utilities.exceptions import SIGTERMException

from repdib_lightning.callbacks.status_file import State, Status
from repdib_lightning.errors import UserError


class RunStatus(Callback):
    """Writes ``<run>/status.json`` when training starts, every few seconds, and when it ends in whatever way.

    Args:
        run: the run's folder.
        every_seconds: seconds between two updates while training or validating.
    """

    def __init__(self, run: Path, every_seconds: float = 10.0) -> None:
        self.run, self.every_seconds = Path(run), every_seconds
        self._status: Status | None = None
        self._written = 0.0

    def on_fit_start(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """The run is running. Raises UserError if the status cannot be written."""
        if trainer.is_global_zero:
            self._status = Status.of_this_process()
            self._fill(trainer).write(self.run)

    def on_train_batch_end(self, trainer: pl.Trainer, pl_module: pl.LightningModule, *_: Any) -> None:
        """Sign of life."""
        self._update(trainer)

    def on_validation_batch_end(self, trainer: pl.Trainer, pl_module: pl.LightningModule, *_: Any) -> None:
        """Sign of life."""
        self._update(trainer)

    def on_fit_end(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """The run is finished."""
        self._end(trainer, "finished")

    def on_exception(self, trainer: pl.Trainer, pl_module: pl.LightningModule, exception: BaseException) -> None:
        """The run was preempted, interrupted, or has failed."""
        if isinstance(exception, SIGTERMException):
            self._end(trainer, "preempted")
        elif isinstance(exception, KeyboardInterrupt):
            self._end(trainer, "interrupted")
        else:
            lines = str(exception).strip().splitlines() or [""]
            message = lines[0] if isinstance(exception, UserError) else f"{type(exception).__name__}: {lines[0]}"
            self._end(trainer, "failed", message)

    def _update(self, trainer: pl.Trainer) -> None:
        if self._status is not None and time.monotonic() - self._written >= self.every_seconds:
            self._write(trainer)

    def _end(self, trainer: pl.Trainer, state: State, error: str = "") -> None:
        if self._status is None:  # training never started: the folder may be another run's
            return
        self._status.state, self._status.error = state, error
        self._write(trainer)
        self._status = None

    def _write(self, trainer: pl.Trainer) -> None:
        """A status that cannot be written is no reason to stop training."""
        self._written = time.monotonic()
        try:
            self._fill(trainer).write(self.run)
        except UserError as error:
            print(f"warning: {error}", file=sys.stderr)

    def _fill(self, trainer: pl.Trainer) -> Status:
        assert self._status is not None
        self._status.step, self._status.epoch = trainer.global_step, trainer.current_epoch
        return self._status
