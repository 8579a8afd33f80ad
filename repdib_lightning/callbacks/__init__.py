"""What watches a run: pictures, codebook use, exact resume, status.

A run is made safe by :func:`run_callbacks` and :func:`run_plugins`, which belong into every Trainer, and is resumed
with ``trainer.fit(..., ckpt_path=last_good(run))`` inside ``with exit_codes():``. Importing this is cheap: Lightning is
only imported where a Trainer is about to be built.

On SLURM, ask for SIGTERM ahead of the time limit (``#SBATCH --signal=TERM@120``) and requeue on exit code 143: the
checkpoint is then taken between two batches, and resuming is exact. Lightning's own way (SIGUSR1) keeps working, its
``hpc_ckpt_N.ckpt`` is written and verified like any other; but it is taken wherever the signal strikes, so that the
step under way may be made twice. A run that is given ``ckpt_path`` does not look at it.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from repdib_lightning.callbacks.checkpoint_files import last_good
from repdib_lightning.callbacks.exit_codes import exit_codes
from repdib_lightning.callbacks.status_file import Status, read_status

__all__ = ["Status", "exit_codes", "last_good", "read_status", "run_callbacks", "run_plugins"]


def run_callbacks(run: Path, every_n_steps: int = 100, keep: int = 3) -> list[Any]:
    """Return the callbacks that every run has, in their order.

    Args:
        run: the run's folder; it is written to from ``on_fit_start`` on.
        every_n_steps: optimiser steps between two checkpoints.
        keep: checkpoints to keep.
    """
    from repdib_lightning.callbacks.checkpointing import RunCheckpoint
    from repdib_lightning.callbacks.exact_resume import ExactResume
    from repdib_lightning.callbacks.non_finite import StopOnNonFinite
    from repdib_lightning.callbacks.run_status import RunStatus

    exact_resume = ExactResume()
    checkpoint = RunCheckpoint(run, exact_resume, every_n_steps, keep)
    return [RunStatus(run), StopOnNonFinite(), exact_resume, checkpoint]


def run_plugins() -> list[Any]:
    """Return the Trainer plugins that every run has."""
    from repdib_lightning.callbacks.checkpoint_io import AtomicCheckpointIO

    return [AtomicCheckpointIO()]
