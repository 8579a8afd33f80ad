"""The non-linear probe: the linear probe, corrected by a small network as far as other episodes confirm it.

A network fitted from scratch on a few episodes of near-copied frames learns those episodes by heart, and reads less
out of a representation than a linear probe does. So the network here starts as the linear probe, and departs from it
only by what lowers the error on episodes that were held out.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional

from repdib_lightning.evaluation.linear import LinearMap

WIDTH, LAYERS, RATE, DECAY = 256, 2, 1e-3, 0.1
LARGEST_BATCH, SMALLEST_BATCH, STEPS_AN_EPOCH = 256, 32, 8
MAX_EPOCHS, PATIENCE, LEAST_GAIN = 25, 5, 0.01
AGREEMENT = 2.0


@dataclass(frozen=True)
class CorrectedMap:
    """A linear map plus a network, and the number of epochs that early stopping chose for it (0: no network)."""

    base: LinearMap
    network: nn.Module | None
    epochs: int

    def __call__(self, features: np.ndarray) -> np.ndarray:
        """Map (n, M) to (n, K): logits, or predictions of standardised targets."""
        linear = self.base(features)
        if self.network is None:
            return linear
        with torch.inference_mode():
            return linear + self.network(torch.from_numpy(np.asarray(features, np.float32))).double().numpy()


@dataclass(frozen=True)
class Task:
    """Rows to fit and the linear map fitted on the same rows.

    Attributes:
        features: (n, M), standardised.
        targets: (n,) int64 classes in [0, K), or (n, K) float, standardised.
        base: (n, M) to (n, K) logits or predictions.
    """

    features: np.ndarray
    targets: np.ndarray
    base: LinearMap


@dataclass(frozen=True)
class Fold:
    """A task that lacks some episodes, and how far a prediction for those episodes is off.

    Attributes:
        task: rows of the other episodes.
        held_out: (m, M) features of the rows that the task lacks.
        error: (m, K) predictions for them to a sum over rows; K is the task's.
    """

    task: Task
    held_out: np.ndarray
    error: Callable[[np.ndarray], float]


def fit_correction(whole: Task, folds: Sequence[Fold], seed: int) -> CorrectedMap:
    """Learn what to add to a linear map: two hidden layers of 256 units, AdamW, early stopping over all folds at once.

    The last layer starts at zero, so that epoch 0 is the linear map itself, and it stays that where no later epoch
    lowers the error of the folds by more than the folds differ (two standard errors). The epochs that lowered it most
    are repeated on all rows.

    Args:
        whole: all rows.
        folds: each leaves out other episodes of them.
        seed: of the initial weights and the order of batches; the same seed gives the same network.
    """
    with torch.inference_mode(False), torch.enable_grad():
        epochs = _best_epoch(folds, seed)
        if epochs == 0:
            return CorrectedMap(whole.base, None, 0)
        trainer = _Trainer(whole, seed)
        for _ in range(epochs):
            trainer.epoch()
    return CorrectedMap(whole.base, trainer.network.eval(), epochs)


def build_mlp(features: int, width: int, generator: torch.Generator) -> nn.Sequential:
    """M -> 256 -> 256 -> K with ReLU; the last layer is zero, the others come from the generator alone."""
    sizes = [features, *[WIDTH] * LAYERS]
    layers: list[nn.Module] = []
    for before, after in itertools.pairwise(sizes):
        layers += [_linear(before, after, math.sqrt(2.0), generator), nn.ReLU()]
    return nn.Sequential(*layers, _linear(WIDTH, width, 0.0, generator))


def _linear(before: int, after: int, gain: float, generator: torch.Generator) -> nn.Linear:
    layer = nn.utils.skip_init(nn.Linear, before, after)
    with torch.no_grad():
        layer.weight.normal_(0.0, gain / math.sqrt(before), generator=generator)
        layer.bias.zero_()
    return layer


class _Trainer:
    def __init__(self, task: Task, seed: int) -> None:
        categorical = task.targets.ndim == 1
        base = task.base(task.features)
        self.x, self.base = (torch.from_numpy(np.asarray(a, np.float32)) for a in (task.features, base))
        self.y = torch.from_numpy(np.asarray(task.targets, np.int64 if categorical else np.float32))
        self.loss: Callable[[Tensor, Tensor], Tensor] = functional.cross_entropy if categorical else functional.mse_loss
        self.generator = torch.Generator().manual_seed(seed)
        self.network = build_mlp(self.x.shape[1], base.shape[1], self.generator)
        self.optimiser = torch.optim.AdamW(self.network.parameters(), lr=RATE, weight_decay=DECAY)
        # Patience counts epochs: on few rows an epoch of one step would end the search before it began.
        self.batch = max(SMALLEST_BATCH, min(LARGEST_BATCH, len(self.x) // STEPS_AN_EPOCH))

    def epoch(self) -> None:
        for rows in torch.randperm(len(self.x), generator=self.generator).split(self.batch):
            self.optimiser.zero_grad()
            self.loss(self.base[rows] + self.network(self.x[rows]), self.y[rows]).backward()
            self.optimiser.step()


def _best_epoch(folds: Sequence[Fold], seed: int) -> int:
    """The epoch of the lowest error over all folds, or 0 where the folds do not agree that it is a gain.

    Training ends when PATIENCE epochs gain next to nothing.
    """
    trainers = [_Trainer(fold.task, seed) for fold in folds]
    linear = np.array([fold.error(fold.task.base(fold.held_out)) for fold in folds])
    best, best_epoch = linear, 0
    for epoch in range(1, MAX_EPOCHS + 1):
        if best.sum() == 0.0:
            break
        for trainer in trainers:
            trainer.epoch()
        errors = np.array([_held_out_error(fold, trainer) for fold, trainer in zip(folds, trainers, strict=True)])
        if errors.sum() < best.sum() * (1.0 - LEAST_GAIN):
            best, best_epoch = errors, epoch
        elif epoch - best_epoch >= PATIENCE:
            break
    return best_epoch if _agreed(linear - best) else 0


def _held_out_error(fold: Fold, trainer: _Trainer) -> float:
    with torch.no_grad():
        added = trainer.network(torch.from_numpy(np.asarray(fold.held_out, np.float32))).double().numpy()
    return fold.error(fold.task.base(fold.held_out) + added)


def _agreed(gains: np.ndarray) -> bool:
    """Whether the mean gain of the folds exceeds AGREEMENT standard errors, so that no single episode decides."""
    error = gains.std(ddof=1) / math.sqrt(len(gains)) if len(gains) > 1 else 0.0
    return bool(gains.mean() > AGREEMENT * error)
