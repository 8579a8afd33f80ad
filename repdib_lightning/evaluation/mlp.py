"""The non-linear probe: what a small network can still read out of a representation."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional

WIDTH, LAYERS, RATE, DECAY = 256, 2, 1e-3, 3.0
LARGEST_BATCH, SMALLEST_BATCH, STEPS_AN_EPOCH = 256, 32, 8
MAX_EPOCHS, PATIENCE, LEAST_GAIN = 100, 10, 1e-3


@dataclass(frozen=True)
class FittedMLP:
    """A fitted network and the number of epochs that early stopping chose."""

    network: nn.Module
    epochs: int

    def __call__(self, features: np.ndarray) -> np.ndarray:
        """Map (n, M) to (n, K): logits, or predictions of standardised targets."""
        with torch.inference_mode():
            return self.network(torch.from_numpy(np.asarray(features, np.float32))).double().numpy()


def fit_mlp(features: np.ndarray, targets: np.ndarray, width: int, held_out: np.ndarray, seed: int) -> FittedMLP:
    """Fit two hidden layers of 256 units with AdamW; early stopping finds the epochs, a second fit uses all rows.

    Args:
        features: (n, M), standardised.
        targets: (n,) int64 classes in [0, K), or (n, K) float, standardised.
        width: K.
        held_out: (n,) bool, rows (whole episodes) that early stopping watches.
        seed: of the initial weights and the order of batches; the same seed gives the same network.
    """
    x = torch.from_numpy(np.asarray(features, np.float32))
    categorical = targets.ndim == 1
    y = torch.from_numpy(np.asarray(targets, np.int64 if categorical else np.float32))
    loss = functional.cross_entropy if categorical else functional.mse_loss
    watched = torch.from_numpy(held_out)
    with torch.inference_mode(False), torch.enable_grad():
        epochs = _best_epochs(x[~watched], y[~watched], x[watched], y[watched], width, loss, seed)
        trainer = _Trainer(x, y, width, loss, seed)
        for _ in range(epochs):
            trainer.epoch()
    return FittedMLP(trainer.network.eval(), epochs)


def build_mlp(features: int, width: int, generator: torch.Generator) -> nn.Sequential:
    """M -> 256 -> 256 -> K with ReLU; weights come from the generator alone, not from the global random state."""
    sizes = [features, *[WIDTH] * LAYERS]
    layers: list[nn.Module] = []
    for before, after in itertools.pairwise(sizes):
        layers += [_linear(before, after, math.sqrt(2.0), generator), nn.ReLU()]
    return nn.Sequential(*layers, _linear(WIDTH, width, 1.0, generator))


def _linear(before: int, after: int, gain: float, generator: torch.Generator) -> nn.Linear:
    layer = nn.utils.skip_init(nn.Linear, before, after)
    with torch.no_grad():
        layer.weight.normal_(0.0, gain / math.sqrt(before), generator=generator)
        layer.bias.zero_()
    return layer


class _Trainer:
    def __init__(self, x: Tensor, y: Tensor, width: int, loss: Callable[[Tensor, Tensor], Tensor], seed: int) -> None:
        self.x, self.y, self.loss = x, y, loss
        self.generator = torch.Generator().manual_seed(seed)
        self.network = build_mlp(x.shape[1], width, self.generator)
        # So strong a decay because neighbouring rows are near copies: without it the network learns the few episodes
        # by heart within three epochs, and reads less out of them than the linear probe.
        self.optimiser = torch.optim.AdamW(self.network.parameters(), lr=RATE, weight_decay=DECAY)
        # Patience counts epochs: on few rows an epoch of one step would end the search before it began.
        self.batch = max(SMALLEST_BATCH, min(LARGEST_BATCH, len(x) // STEPS_AN_EPOCH))

    def epoch(self) -> None:
        for rows in torch.randperm(len(self.x), generator=self.generator).split(self.batch):
            self.optimiser.zero_grad()
            self.loss(self.network(self.x[rows]), self.y[rows]).backward()
            self.optimiser.step()


def _best_epochs(
    x: Tensor,
    y: Tensor,
    watched_x: Tensor,
    watched_y: Tensor,
    width: int,
    loss: Callable[[Tensor, Tensor], Tensor],
    seed: int,
) -> int:
    """Epochs after which the watched loss was lowest; the search ends when PATIENCE epochs gain next to nothing."""
    trainer = _Trainer(x, y, width, loss, seed)
    best, best_epoch = math.inf, 1
    for epoch in range(1, MAX_EPOCHS + 1):
        trainer.epoch()
        with torch.no_grad():
            watched = float(loss(trainer.network(watched_x), watched_y))
        if watched < best - LEAST_GAIN:
            best, best_epoch = watched, epoch
        elif epoch - best_epoch >= PATIENCE:
            break
    return best_epoch
