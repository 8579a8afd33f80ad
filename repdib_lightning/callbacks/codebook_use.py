"""How many codes each group, and each modality, uses on the held-out data."""

from __future__ import annotations

from typing import Any

import lightning.pytorch as pl
import torch
from lightning.pytorch.callbacks import Callback
from torch import Tensor, nn
from torchmetrics import Metric

from repdib_lightning.bottlenecks.base import Bottleneck
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

    Names: ``val/perplexity/group_0`` (effective number of codes, 1 to L), ``val/used/group_0`` (codes that occur). An
    encoder that quantises its modalities adds ``val/perplexity/cam1`` and ``val/used/cam1``, means over their groups.
    Nothing is logged for bottlenecks without codes, or before the quantiser has started.
    """

    def __init__(self) -> None:
        self._histogram: CodeHistogram | None = None
        self._inside: dict[str, CodeHistogram] = {}
        self._hook: Any = None

    def on_validation_start(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Listen to what the module returns."""
        self._inside = {}
        if _quantiser(pl_module) is not None:
            self._hook = pl_module.register_forward_hook(self._count)

    def _count(self, module: Any, inputs: Any, output: Any) -> None:
        if not isinstance(output, BottleneckOutput):  # of a whole step, where several processes train
            return
        if output.codes is not None:
            if self._histogram is None:
                self._histogram = CodeHistogram(module.bottleneck.groups, module.bottleneck.codes).to(module.device)
            self._histogram.update(output.codes)
        for name, codes in output.codes_inside.items():
            if name not in self._inside:
                quantiser = _quantiser(module.encoder)
                assert quantiser is not None
                self._inside[name] = CodeHistogram(quantiser.groups, quantiser.codes).to(module.device)
            self._inside[name].update(codes[(codes >= 0).all(dim=1)])  # less those of clips that lack the modality

    def on_validation_epoch_end(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Log what was counted."""
        if self._hook is None:
            return
        self._hook.remove()
        histogram, inside = self._histogram, self._inside
        self._histogram, self._inside, self._hook = None, {}, None
        if trainer.sanity_checking:
            return
        values: dict[str, float] = {}
        for name, codes in inside.items():
            counts = codes.compute()
            if not counts.any():
                continue
            values[f"val/perplexity/{name}"] = float(perplexity(counts).mean())
            values[f"val/used/{name}"] = float((counts > 0).sum(-1).float().mean())
        if histogram is not None:
            counts = histogram.compute()
            values |= {f"val/perplexity/group_{g}": float(value) for g, value in enumerate(perplexity(counts))}
            values |= {f"val/used/group_{g}": float(value) for g, value in enumerate((counts > 0).sum(-1))}
            shares = counts.sort(-1, descending=True).values / counts.amax(-1, keepdim=True).clamp(min=1)
            for writer in tensorboards(trainer):
                writer.add_image("codes/use", shares[None], trainer.global_step)
        pl_module.log_dict(values, sync_dist=True)


def _quantiser(module: nn.Module) -> Bottleneck | None:
    """The first bottleneck with codes inside; all modalities of an encoder have the same."""
    return next((part for part in module.modules() if isinstance(part, Bottleneck) and part.groups), None)
