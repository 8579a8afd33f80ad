"""Ends a run in other ways than after a batch by SIGKILL."""

from __future__ import annotations

import os
import signal
import time
from typing import Any, Literal

import lightning.pytorch as pl
from lightning.pytorch.callbacks import Callback


class EndBy(Callback):
    """Send a signal to this process, and to those that it has started.

    Args:
        name: of the signal, such as ``SIGTERM``.
        when: after a ``batch``, while the next one is being collected (``acting``), or after the last checkpoint
            (``fit_end``), before anything is closed.
        batches: of the whole run, after which it is time.
    """

    def __init__(self, name: str, when: Literal["batch", "acting", "fit_end"], batches: int = 0) -> None:
        self.signal, self.when, self.batches = signal.Signals[name], when, batches

    def on_train_batch_end(self, trainer: pl.Trainer, pl_module: pl.LightningModule, *_: Any) -> None:
        if trainer.global_step == self.batches and self.when == "batch":
            self._end()
        elif trainer.global_step == self.batches and self.when == "acting":
            act = pl_module.act
            pl_module.act = lambda *given: (self._end(), act(*given))[1]

    def on_fit_end(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        if self.when == "fit_end":
            self._end()

    def _end(self) -> None:
        """A group's signal reaches the children first."""
        with open(f"/proc/self/task/{os.getpid()}/children") as file:
            children = [int(child) for child in file.read().split()]
        for process in (*children, os.getpid()):
            os.kill(process, self.signal)
        time.sleep(0.5)  # until a child that dies of it is gone
