"""Shows in TensorBoard what the model sees."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import lightning.pytorch as pl
import torch
from lightning.pytorch.callbacks import Callback
from lightning.pytorch.loggers import TensorBoardLogger
from torch import Tensor
from torch.utils.tensorboard import SummaryWriter

from repdib_lightning.encoders.augmentation import random_shift
from repdib_lightning.records import Batch

MOST_FRAMES = 8


class Pictures(Callback):
    """Logs a grid of a batch when training starts: one row a sample, its anchor, its futures, each newest frame; of
    a video up to 8 frames of the anchor.

    Args:
        samples: rows of the grid.
    """

    def __init__(self, samples: int = 8) -> None:
        self.samples = samples
        self._shown = False

    def on_train_batch_start(
        self, trainer: pl.Trainer, pl_module: pl.LightningModule, batch: Batch, batch_idx: int
    ) -> None:
        """Log the first batch of this process, with the random shift of the training."""
        if self._shown:
            return
        self._shown = True
        with torch.random.fork_rng():  # the picture's shifts must not change the training's
            for writer in tensorboards(trainer):
                for name, frames in batch.observations.items():
                    if frames.dtype == torch.uint8 and frames.ndim in (5, 6):
                        draw = picture_grid if frames.ndim == 5 else video_grid
                        grid = draw(frames[: self.samples], getattr(pl_module, "shift", 0))
                        writer.add_image(f"input/{name}", grid, trainer.global_step)


def picture_grid(frames: Tensor, shift: int) -> Tensor:
    """Lay out (R, F, S * C, H, W) uint8 frames as one (3, R * H, F * W) picture of the newest frame of each stack."""
    rows, columns, channels, height, width = frames.shape
    newest = 3 if channels % 3 == 0 else 1
    shifted = random_shift(frames.flatten(0, 1), shift)[:, -newest:].expand(-1, 3, -1, -1)
    tiles = shifted.unflatten(0, (rows, columns)).permute(2, 0, 3, 1, 4)
    return tiles.reshape(3, rows * height, columns * width)


def video_grid(videos: Tensor, shift: int) -> Tensor:
    """Lay out (R, F, T, C, H, W) uint8 videos as one (3, R * H, n * W) picture of n of the frames of each anchor."""
    anchors = random_shift(videos[:, 0], shift)
    return picture_grid(anchors[:, :: -(-anchors.shape[1] // MOST_FRAMES)], 0)


def tensorboards(trainer: pl.Trainer) -> Iterator[SummaryWriter | Any]:
    """The TensorBoard writers of a trainer, on the process that logs."""
    if trainer.is_global_zero:
        for logger in trainer.loggers:
            if isinstance(logger, TensorBoardLogger):
                yield logger.experiment
