"""What happens at the end of each epoch: a checkpoint, an evaluation, a row of progress.csv."""

from __future__ import annotations

import csv
import math
import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import lightning.pytorch as pl
import torch
from lightning.pytorch.loggers import Logger
from lightning.pytorch.utilities.exceptions import SIGTERMException
from tqdm import tqdm

from repdib_lightning.callbacks import generators
from repdib_lightning.data.files import whole_file
from repdib_lightning.errors import UserError
from repdib_lightning.rl.decision_transformer.batches import WindowBatches
from repdib_lightning.rl.decision_transformer.checkpoints import put_back, save_checkpoint
from repdib_lightning.rl.decision_transformer.module import DecisionTransformerModule
from repdib_lightning.rl.options import PROGRESS

_LOOKED_AT = 50
"""Updates between two looks at the loss."""

_COLUMNS = ("step", "epoch", "eval/return", "eval/return_deviation", "eval/normalised")
_TRAINED = ("train/loss", "train/accuracy", "train/learning_rate")

Evaluate = Callable[[bool], dict[str, float]]
"""Told whether this is the last time; gives ``return``, ``return_deviation``, and ``normalised`` where it is known."""


class EpochProgress(pl.Callback):
    """Writes a checkpoint and a row of ``progress.csv`` after each epoch, and moves a bar where there is a terminal.

    The checkpoint comes first: what is killed while it is evaluated goes on with the evaluation. Whatever an evaluation
    draws of the global generators is given back, so that a resumed training goes on bit for bit.

    Columns: ``step`` (updates), ``epoch``, ``eval/...`` where it was evaluated, ``train/loss`` and ``train/accuracy``
    over the epoch, ``train/learning_rate`` at its end.

    Args:
        folder: of the run. batches: of the training. every: epochs between evaluations. evaluate: or None.
        logger: gets the same numbers, and those of single updates. fingerprint: of the data.

    Attributes:
        done: batches so far. rows: of progress.csv. measures: of the last epoch.

    Raises:
        UserError: losses that are no longer finite, once they are looked at.
    """

    def __init__(
        self,
        folder: Path,
        batches: WindowBatches,
        *,
        every: int,
        evaluate: Evaluate | None,
        logger: Logger,
        fingerprint: str,
    ) -> None:
        self.folder, self.batches, self.every, self.evaluate = folder, batches, every, evaluate
        self.logger, self.fingerprint = logger, fingerprint
        self.done = 0
        self.rows: list[dict[str, float]] = []
        self.measures: dict[str, float] = {}
        self._resumed: dict[str, Any] | None = None

    @property
    def per_epoch(self) -> int:
        """Batches."""
        return self.batches.order.batches

    def go_on(self, state: Mapping[str, Any], module: DecisionTransformerModule) -> None:
        """Go on after a checkpoint: what was left to do at the end of its epoch is done now."""
        put_back(state, module)
        self.done = self.batches.first = int(state["number"])
        self.rows, self._resumed = list(state["rows"]), dict(state)
        if self.done and self.done % self.per_epoch == 0:
            self._close_epoch(module)

    def on_train_start(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Put the optimiser back, and open the bar."""
        self._bar = tqdm(total=self.batches.total, initial=self.done, unit=" updates", disable=not sys.stderr.isatty())
        if self._resumed is not None:
            trainer.optimizers[0].load_state_dict(self._resumed["optimizer"])

    def on_train_batch_start(self, trainer: pl.Trainer, pl_module: pl.LightningModule, *_: Any) -> None:
        """Put the generators back before the first batch: whatever came earlier may have drawn from them."""
        if self._resumed is not None:
            generators.restore(self._resumed["generators"], pl_module.device)
            self._resumed = None

    def on_train_batch_end(self, trainer: pl.Trainer, pl_module: pl.LightningModule, *_: Any) -> None:
        """Look at the loss now and then, and close each epoch."""
        assert isinstance(pl_module, DecisionTransformerModule)
        self.done += 1
        self._bar.update()
        ended = self.done % self.per_epoch == 0
        if ended or self.done % _LOOKED_AT == 0:
            now = {"update/loss": float(pl_module.loss), "update/learning_rate": pl_module.rate}
            self._check_finite("the loss", now["update/loss"])
            self.logger.log_metrics(now, step=self.done)
        if ended:
            self._check_finite("the mean loss", float(pl_module.sums[0]))
            self._save(trainer, pl_module)
            self._close_epoch(pl_module)

    def on_exception(self, trainer: pl.Trainer, pl_module: pl.LightningModule, exception: BaseException) -> None:
        """Write a checkpoint where SIGTERM ended an epoch between two batches."""
        assert isinstance(pl_module, DecisionTransformerModule)
        if not isinstance(exception, SIGTERMException) or self.done % self.per_epoch == 0:
            return
        try:
            self._check_finite("the loss", float(pl_module.loss))
            self._save(trainer, pl_module)
        except UserError as error:
            print(f"warning: no checkpoint on SIGTERM: {error}", file=sys.stderr)

    def on_train_end(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Close the bar."""
        self._bar.close()

    def _save(self, trainer: pl.Trainer, module: DecisionTransformerModule) -> None:
        save_checkpoint(
            self.folder,
            self.done,
            module,
            trainer.optimizers[0],
            rows=self.rows,
            fingerprint=self.fingerprint,
            batches_per_epoch=self.per_epoch,
        )

    def _close_epoch(self, module: DecisionTransformerModule) -> None:
        """Evaluate where that is due, write the row, and begin the next epoch."""
        loss, right, tokens = module.sums.tolist()
        epoch, last = self.done // self.per_epoch, self.done == self.batches.total
        self.measures = {"loss": loss / tokens, "accuracy": right / tokens}
        row: dict[str, float] = {"step": self.done, "epoch": epoch}
        if self.evaluate is not None and (last or epoch % self.every == 0):
            found = self._evaluated(self.evaluate, module, last)
            row |= {f"eval/{name}": value for name, value in found.items()}
            self.measures |= found
        row |= {"train/loss": loss / tokens, "train/accuracy": right / tokens, "train/learning_rate": module.rate}
        self.rows.append(row)
        self._write()
        self.logger.log_metrics({name: v for name, v in row.items() if "/" in name}, step=self.done)
        module.begin_epoch()

    def _evaluated(self, evaluate: Evaluate, module: DecisionTransformerModule, last: bool) -> dict[str, float]:
        drawn, mode = generators.capture(module.device), module.training
        module.eval()
        with torch.inference_mode():
            found = evaluate(last)
        module.train(mode)
        generators.restore(drawn, module.device)
        return found

    def _write(self) -> None:
        known = {name for row in self.rows for name in row}
        columns = [name for name in (*_COLUMNS, *_TRAINED) if name in known]
        with whole_file(self.folder / PROGRESS) as aside, open(aside, "w", newline="") as file:
            table = csv.DictWriter(file, columns)
            table.writeheader()
            for row in self.rows:
                shown = {name: value if name in ("step", "epoch") else f"{value:.6g}" for name, value in row.items()}
                table.writerow(shown)

    def _check_finite(self, what: str, value: float) -> None:
        if not math.isfinite(value):
            raise UserError(f"{what} is {value} after {self.done} updates; try a smaller --learning_rate")
