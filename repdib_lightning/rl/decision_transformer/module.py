"""The Decision Transformer as a LightningModule: cross-entropy on the actions of windows."""

from __future__ import annotations

import math
from typing import Any

import lightning.pytorch as pl
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from repdib_lightning.encoders.base import Encoder
from repdib_lightning.rl.decision_transformer.batches import IGNORED, WindowBatch, stacked_frames
from repdib_lightning.rl.decision_transformer.network import DecisionTransformer

_BETAS = (0.9, 0.95)
_CLIP = 1.0
_LEAST_RATE = 0.1
"""Of the learning rate: it falls no further."""
COSINE_EPOCHS = 6
"""Over which the learning rate falls, or over all where there are more. The published program counts tokens as steps,
``2 * 3 * context`` for each window of the data, and trains for five epochs."""

_STEPS = {"cpu": 2048}
"""Steps of windows that go through the transformer at a time; all of a batch on other devices."""

_PICTURE_BYTES = {"cpu": 32 << 20, "cuda": 1 << 30}
"""Of stacked pictures as float32 that an encoder is given at a time: on a CPU what stays near its cache."""


class DecisionTransformerModule(pl.LightningModule):
    """Trains a network on windows; and an encoder with it, where the windows are of pictures.

    AdamW with betas (0.9, 0.95), weight decay on the weights of linear layers and convolutions alone, gradients clipped
    at a norm of 1. The learning rate rises over ``warmup_tokens``, then falls as a cosine that would reach 0 at
    ``tokens``, but not below a tenth; a token is a step of a window. Published, but for the first update, which there
    has the whole rate.

    Args:
        network: the transformer. encoder: that is trained, pictures to (N, width); None where states are vectors.
        learning_rate, weight_decay: AdamW's. warmup_tokens: of the rise. tokens: of the rise and fall.

    Attributes:
        read: tokens so far. sums: (3,) float64: of the losses, of right guesses, and of tokens since
            :meth:`begin_epoch`. loss: of the last update, a scalar. rate: its learning rate.
    """

    def __init__(
        self,
        network: DecisionTransformer,
        encoder: Encoder | None,
        *,
        learning_rate: float,
        weight_decay: float,
        warmup_tokens: int,
        tokens: int,
    ) -> None:
        super().__init__()
        self.automatic_optimization = False
        self.network, self.encoder = network, encoder
        self.learning_rate, self.weight_decay = learning_rate, weight_decay
        self.warmup_tokens, self.tokens = warmup_tokens, tokens
        self.read, self.rate = 0, 0.0
        self.loss, self.sums = torch.zeros(()), torch.zeros(3, dtype=torch.float64)

    def begin_epoch(self) -> None:
        """Count losses and right guesses from here."""
        self.sums = torch.zeros_like(self.sums)

    def configure_optimizers(self) -> torch.optim.Optimizer:
        """AdamW, which updates all weights in one pass."""
        decayed = _decayed(self)
        known = {id(weight) for weight in decayed}
        kept = [weight for weight in self.parameters() if id(weight) not in known]
        groups = [
            {"params": decayed, "weight_decay": self.weight_decay},
            {"params": kept, "weight_decay": 0.0},
        ]
        return torch.optim.AdamW(groups, lr=self.learning_rate, betas=_BETAS, fused=True)

    def training_step(self, batch: WindowBatch, number: int) -> None:
        """One update, of as many parts as the pictures ask for; their gradients add up to that of the batch."""
        optimizer: Any = self.optimizers(use_pl_optimizer=False)
        optimizer.zero_grad(set_to_none=True)
        sums = torch.zeros(2, dtype=torch.float64, device=self.device)
        for part in self._parts(batch):
            loss, right = self.evaluate(part)
            (loss / batch.steps).backward()
            sums += torch.stack([loss.detach(), right]).double()
        torch.nn.utils.clip_grad_norm_(self.parameters(), _CLIP, foreach=True)
        self.read += batch.steps
        self.rate = self.learning_rate * schedule(self.read, self.warmup_tokens, self.tokens)
        for group in optimizer.param_groups:
            group["lr"] = self.rate
        optimizer.step()
        self.loss = sums[0] / batch.steps
        self.sums = self.sums.to(self.device) + F.pad(sums, (0, 1), value=batch.steps)

    def evaluate(self, batch: WindowBatch) -> tuple[Tensor, Tensor]:
        """Summed cross-entropy of a batch, and how often the likeliest action is that of the data; two scalars."""
        logits = self.network(self._states(batch), batch.returns, batch.actions, batch.first)
        logits, targets = logits.flatten(0, 1), batch.targets.flatten()
        loss = F.cross_entropy(logits, targets, ignore_index=IGNORED, reduction="sum")
        return loss, (logits.detach().argmax(-1) == targets).sum()

    def _states(self, batch: WindowBatch) -> Tensor:
        if not isinstance(batch.seen, dict):
            return batch.seen
        assert self.encoder is not None
        stack = self.encoder.spec.frame_stack
        pictures = {name: stacked_frames(frames, stack) for name, frames in batch.seen.items()}
        features: Tensor = self.encoder(pictures)
        return features.unflatten(0, tuple(batch.actions.shape))

    def _parts(self, batch: WindowBatch) -> list[WindowBatch]:
        """The batch, cut so that what is at work at a time stays small: the largest part of it are activations."""
        kind, steps = self.device.type, batch.actions.shape[1]
        count = max(1, _STEPS.get(kind, batch.actions.numel()) // steps)
        if isinstance(batch.seen, dict):
            assert self.encoder is not None
            sizes = [array.shape for array in self.encoder.spec.observations.values()]
            window = 4 * sum(map(math.prod, sizes)) * steps
            count = min(count, max(1, _PICTURE_BYTES.get(kind, _PICTURE_BYTES["cpu"]) // window))
        return [batch.part(slice(start, start + count)) for start in range(0, len(batch), count)]


def schedule(read: int, warmup: int, tokens: int) -> float:
    """Share of the learning rate after so many tokens: a line to 1, then a cosine down to a tenth."""
    if read < warmup:
        return read / warmup
    progress = (read - warmup) / max(1, tokens - warmup)
    return max(_LEAST_RATE, 0.5 * (1.0 + math.cos(math.pi * min(1.0, progress))))


def _decayed(module: nn.Module) -> list[Tensor]:
    """Weights of linear layers and convolutions."""
    layers = [part for part in module.modules() if isinstance(part, (nn.Linear, nn.Conv2d))]
    return [layer.weight for layer in layers]
