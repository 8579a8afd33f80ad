"""Rows of a batch brought to mean 0 and deviation 1."""

from __future__ import annotations

import torch
from torch import Tensor

from repdib_lightning.bottlenecks.precision import SinglePrecision
from repdib_lightning.processes import gather_with_gradients

_RATE = 0.05
_LEAST = 1e-5


class BatchStandardisation(SinglePrecision):
    """Subtracts the mean and divides by the deviation of each dimension: in training those of the batch of all
    processes, with their gradient (Ioffe and Szegedy 2015, without scale and shift); else running averages of these.

    Args:
        width: P.
    """

    mean: Tensor
    variance: Tensor

    def __init__(self, width: int) -> None:
        super().__init__()
        self.register_buffer("mean", torch.zeros(width))
        self.register_buffer("variance", torch.ones(width))

    def forward(self, rows: Tensor) -> Tensor:
        """(N, P) to (N, P)."""
        if not self.training:
            return self.as_before(rows)
        everywhere, _ = gather_with_gradients(rows, equal=True)
        variance, mean = torch.var_mean(everywhere, dim=0, correction=0)
        with torch.no_grad():
            self.mean.lerp_(mean.to(self.mean.dtype), _RATE)
            self.variance.lerp_(variance.to(self.variance.dtype), _RATE)
        return (rows - mean) / (variance + _LEAST).sqrt()

    def as_before(self, rows: Tensor) -> Tensor:
        """(N, P) to (N, P), by the running averages, which stay as they are."""
        return (rows - self.mean) / (self.variance + _LEAST).sqrt()
