"""Notes what each process of a run saw and where it ended."""

from __future__ import annotations

from collections import defaultdict
from pathlib import Path
from typing import Any

import lightning.pytorch as pl
import torch
from lightning.pytorch.callbacks import Callback


class Watch(Callback):
    """Writes ``seen.RANK.pt`` into a folder: the rows of every batch by stage, and the final state of the module.

    Args:
        folder: where to write.
    """

    def __init__(self, folder: str) -> None:
        self.folder = Path(folder)
        self.rows: dict[str, list[torch.Tensor]] = defaultdict(list)

    def on_train_batch_end(self, trainer: pl.Trainer, module: pl.LightningModule, outputs: Any, batch: Any, *_) -> None:
        self.rows["train"].append(batch.rows)

    def on_validation_batch_end(
        self, trainer: pl.Trainer, module: pl.LightningModule, outputs: Any, batch: Any, *_
    ) -> None:
        if not trainer.sanity_checking:
            self.rows[f"validation {trainer.global_step}"].append(batch.rows)

    def on_fit_end(self, trainer: pl.Trainer, module: pl.LightningModule) -> None:
        note = {"rows": dict(self.rows), "state": module.state_dict()}
        torch.save(note, self.folder / f"seen.{trainer.global_rank}.pt")
