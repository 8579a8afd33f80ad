"""Evaluates an offline agent while it learns: one row of progress.csv each time."""

from __future__ import annotations

import csv
import math
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import lightning.pytorch as pl
import numpy as np
from tqdm import tqdm

from repdib_lightning.errors import UserError
from repdib_lightning.rl.options import PROGRESS
from repdib_lightning.rl.td3_bc import BehaviourCloning


class OfflineProgress(pl.Callback):
    """Writes ``progress.csv``, logs the same to TensorBoard, and moves a bar where there is a terminal.

    Columns: ``step``; ``eval/return`` (mean) and ``eval/normalised`` (that over 10: V-D4RL's score of a return from 0
    to 1000); ``train/...`` of the last update.

    Args:
        folder: of the run. every: updates between evaluations. steps: updates in all.
        evaluate: gives returns (n,) when told whether this is the last time; or None.

    Attributes:
        returns: (n,) of the last evaluation; empty without one.

    Raises:
        UserError: losses or returns that are no longer finite, once they are looked at.
    """

    def __init__(self, folder: Path, every: int, steps: int, evaluate: Callable[[bool], np.ndarray] | None) -> None:
        self.folder, self.every, self.steps, self.evaluate = folder, every, steps, evaluate
        self.rows: list[dict[str, float]] = []
        self.returns = np.empty(0)

    def on_train_start(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Open the bar."""
        self._bar = tqdm(total=self.steps, unit=" updates", disable=not sys.stderr.isatty())

    def on_train_batch_end(
        self, trainer: pl.Trainer, pl_module: pl.LightningModule, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        """Evaluate at every ``every`` updates and after the last one."""
        self._bar.update()
        done = batch_idx + 1
        if done % self.every and done != self.steps:
            return
        assert isinstance(pl_module, BehaviourCloning)
        trained = {f"train/{name}": float(value) for name, value in pl_module.latest.items()}
        _check_finite(trained, done)  # first: a simulator does not take actions that are no numbers
        row: dict[str, float] = {"step": done}
        if self.evaluate is not None:
            pl_module.eval()
            self.returns = self.evaluate(done == self.steps)
            pl_module.train()
            reached = float(self.returns.mean())
            row |= {"eval/return": reached, "eval/normalised": reached / 10.0}
            self._bar.set_postfix_str(f"return {reached:.0f}")
        row |= trained
        _check_finite(row, done)
        self.rows.append(row)
        if trainer.logger is not None:
            trainer.logger.log_metrics({name: value for name, value in row.items() if name != "step"}, step=done)
        with open(self.folder / PROGRESS, "w" if len(self.rows) == 1 else "a", newline="") as file:
            table = csv.DictWriter(file, list(self.rows[0]))
            if len(self.rows) == 1:
                table.writeheader()
            table.writerow({name: value if name == "step" else f"{value:.6g}" for name, value in row.items()})

    def on_train_end(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Close the bar."""
        self._bar.close()

    def curve(self, name: str) -> np.ndarray:
        """(n,) values of a column, in order."""
        return np.array([row[name] for row in self.rows if name in row])


def _check_finite(row: dict[str, float], done: int) -> None:
    for name, value in row.items():
        if not math.isfinite(value):
            raise UserError(f"{name} is {value} after {done} updates; try a smaller --learning_rate")
