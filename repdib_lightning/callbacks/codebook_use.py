"""How many codes each group uses on the held-out data."""

from __future__ import annotations

from typing import Any

import lightning.pytorch as pl
import torch
from lightning.pytorch.callbacks import Callback
from torch import Tensor
from torchmetrics import Metric

from repdib_lightning.bottlenecks.codebook import count_codes, perplexity
from repdib_lightning.callbacks.pictures import tensorboards
from repdib_lightning.records import BottleneckOutput


class CodeHistogram(Metric):
    """Counts of each code: (N, G) indices to (G, L), summed over batches and processes."""

    counts: Tensor

    def __init__(self, groups: int, codes: int) -> None:
        super().__init__()
        self.codes = codes
        self.add_state("counts", torch.zeros(groups, codes), dist_reduce_fx="sum")

    def update(self, codes: Tensor) -> None:
        """Add (N, G) int64 indices."""
        self.counts += count_codes(codes, self.codes)

    def compute(self) -> Tensor:
        """The (G, L) counts."""
        return self.counts


class CodebookUse(Callback):
    """Logs, at the end of each validation, perplexity and used codes of every group, and a picture of the histogram.

    Names: ``val/perplexity/group_0`` (effective number of codes, 1 to L), ``val/used/group_0`` (codes that occur).
    Nothing is logged for bottlenecks without codes, or before the quantiser has started.
    """

    def __init__(self) -> None:
        self._histogram: CodeHistogram | None = None
        self._hook: Any = None

    def on_validation_start(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Listen to what the bottleneck returns."""
        bottleneck: Any = pl_module.bottleneck
        if not bottleneck.groups:
            return
        self._histogram = CodeHistogram(bottleneck.groups, bottleneck.codes).to(pl_module.device)
        self._hook = bottleneck.register_forward_hook(self._count)

    def _count(self, module: Any, inputs: Any, output: BottleneckOutput) -> None:
        if output.codes is not None and self._histogram is not None:
            self._histogram.update(output.codes)

    def on_validation_epoch_end(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Log what was counted."""
        if self._hook is None:
            return
        self._hook.remove()
        assert self._histogram is not None
        histogram, self._histogram, self._hook = self._histogram, None, None
        if trainer.sanity_checking or not histogram.update_called:
            return
        counts = histogram.compute()
        values = {f"val/perplexity/group_{g}": float(value) for g, value in enumerate(perplexity(counts))}
        values |= {f"val/used/group_{g}": float(value) for g, value in enumerate((counts > 0).sum(-1))}
        pl_module.log_dict(values, sync_dist=True)
        shares = counts.sort(-1, descending=True).values / counts.amax(-1, keepdim=True).clamp(min=1)
        for writer in tensorboards(trainer):
            writer.add_image("codes/use", shares[None], trainer.global_step)
