"""When checkpoints are written, and how many are kept."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import lightning.pytorch as pl
from lightning.pytorch.callbacks import Checkpoint
from lightning.pytorch.utilities.exceptions import SIGTERMException

from repdib_lightning.callbacks.checkpoint_files import FOLDER, listed, step_of, step_path, sweep_temporaries
from repdib_lightning.callbacks.exact_resume import ExactResume
from repdib_lightning.errors import UserError


class RunCheckpoint(Checkpoint):
    """Writes ``<run>/checkpoints/step-00000123.ckpt`` and keeps the newest few.

    A checkpoint that is due after step n is taken when the next batch is about to begin: the step's validation,
    scheduler updates and hooks are then over, so nothing is lost or done twice on resume. One is written before the
    first batch (so that a run can always be resumed), every ``every_n_steps``, at the end, and on SIGTERM.

    Args:
        run: the run's folder.
        exact_resume: the callback that knows where training stands; it must be among the trainer's callbacks.
        every_n_steps: optimiser steps between two checkpoints.
        keep: how many to keep; the newest is used to resume, the others where that one is damaged.

    Raises:
        UserError: ``every_n_steps`` or ``keep`` is below 1; while training: a checkpoint cannot be written.
    """

    def __init__(self, run: Path, exact_resume: ExactResume, every_n_steps: int = 100, keep: int = 3) -> None:
        for name, value in (("every_n_steps", every_n_steps), ("keep", keep)):
            if value < 1:
                raise UserError(f"checkpoint {name} must be at least 1, is {value}")
        self.folder = Path(run) / FOLDER
        self.exact_resume, self.every_n_steps, self.keep = exact_resume, every_n_steps, keep
        self.newest: Path | None = None
        self._saved_step = -1
        self._abandoned: list[Path] = []

    def on_train_start(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Clear what a killed process left half-written."""
        known: list[Any] = trainer.callbacks  # type: ignore[attr-defined]
        assert self.exact_resume in known, "RunCheckpoint needs its ExactResume among the callbacks"
        if trainer.is_global_zero:
            sweep_temporaries(self.folder)
        if trainer.ckpt_path is not None:
            self.newest, self._saved_step = Path(trainer.ckpt_path), trainer.global_step
            self._abandoned = [path for path in listed(self.folder) if step_of(path) > trainer.global_step]

    def on_train_batch_start(
        self, trainer: pl.Trainer, pl_module: pl.LightningModule, batch: Any, batch_idx: int
    ) -> None:
        """Write the checkpoint that the last step left due."""
        if trainer.global_step % self.every_n_steps == 0:
            self._save(trainer)

    def on_train_end(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Write the last checkpoint."""
        self._save(trainer)

    def on_exception(self, trainer: pl.Trainer, pl_module: pl.LightningModule, exception: BaseException) -> None:
        """Write a checkpoint if SIGTERM ended the run between two batches.

        Not where it broke off a validation: half of that is over, and resuming would not be exact. Nor with several
        processes, of which not all may get here, while a checkpoint needs them all. Then the last one has to do.
        """
        if not isinstance(exception, SIGTERMException) or trainer.world_size > 1 or not trainer.training:
            return
        try:
            self._save(trainer)
        except UserError as error:
            print(f"warning: no checkpoint on SIGTERM: {error}; the newest is {self.newest}", file=sys.stderr)

    def _save(self, trainer: pl.Trainer) -> None:
        step = trainer.global_step
        if step == self._saved_step or not self.exact_resume.progress.between_steps(trainer):
            return
        path = step_path(self.folder, step)
        trainer.save_checkpoint(path, weights_only=False)
        self.newest, self._saved_step = path, step
        if trainer.is_global_zero:
            self._retire(path)

    def _retire(self, saved: Path) -> None:
        """Remove what is too old, and what the run had to go back behind on resume: damaged, most likely."""
        for path in set(self._abandoned) - {saved}:
            path.unlink(missing_ok=True)
        self._abandoned = []
        for path in listed(self.folder)[self.keep :]:
            path.unlink(missing_ok=True)
