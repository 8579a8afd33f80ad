"""Ends a run in other ways than after a batch by SIGKILL."""

from __future__ import annotations

import os
import signal
from typing import Any

import lightning.pytorch as pl
from lightning.pytorch.callbacks import Callback


class EndBy(Callback):
    """Send a signal to this process.

    Args:
        name: of the signal, such as ``SIGTERM``.
        batches: after so many of the whole run; 0 for after the last checkpoint, before anything is closed.
        children: send it to the processes that this one has started, too, as who asks for the whole job to end does.
    """

    def __init__(self, name: str, batches: int = 0, children: bool = False) -> None:
        self.signal, self.batches, self.children = signal.Signals[name], batches, children

    def on_train_batch_end(self, trainer: pl.Trainer, pl_module: pl.LightningModule, *_: Any) -> None:
        if self.batches and trainer.global_step == self.batches:
            self._end()

    def on_fit_end(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        if not self.batches:
            self._end()

    def _end(self) -> None:
        if self.children:
            with open(f"/proc/self/task/{os.getpid()}/children") as file:
                for child in file.read().split():
                    os.kill(int(child), self.signal)
        os.kill(os.getpid(), self.signal)
