"""Lightning's trainer for an agent that learns from one pass over the batches of a recording."""

from __future__ import annotations

from pathlib import Path

import lightning.pytorch as pl
import torch
from lightning.pytorch.loggers import Logger
from lightning.pytorch.plugins.environments import SLURMEnvironment


def one_pass_trainer(
    folder: Path, device: torch.device, *, batches: int, callback: pl.Callback, logger: Logger, log_every: int
) -> pl.Trainer:
    """A trainer without checkpoints, bars or requeueing of its own.

    Args:
        folder: of the run. device: that trains. batches: how many. callback: sees to progress. logger: of single
            updates. log_every: updates between two of those that are logged.
    """
    return pl.Trainer(
        max_epochs=1,
        limit_train_batches=batches,
        accelerator=device.type,
        devices=1 if device.index is None else [device.index],
        logger=logger,
        callbacks=[callback],
        log_every_n_steps=log_every,
        enable_checkpointing=False,
        enable_progress_bar=False,
        enable_model_summary=False,
        default_root_dir=folder,
        plugins=[SLURMEnvironment(auto_requeue=False)] if SLURMEnvironment.detect() else None,
    )
