"""Means over all held-out samples of all processes."""

from __future__ import annotations

import torch
from torch import Tensor
from torchmetrics import SumMetric


class SampleMeans:
    """Collects batch means and weighs each by its samples.

    Lightning's own mean rounds the number of samples where processes hold unequally many (seen in 2.6.6), so that the
    held-out losses of several processes would differ from those of one.
    """

    def __init__(self) -> None:
        self._sums: dict[str, SumMetric] = {}
        self._samples: dict[str, SumMetric] = {}

    @torch.no_grad()
    def add(self, values: dict[str, Tensor], samples: int) -> None:
        """Add the scalar means of one batch of so many samples."""
        for name, value in values.items():
            if name not in self._sums:
                self._sums[name] = SumMetric(nan_strategy="disable").to(value.device)
                self._samples[name] = SumMetric().to(value.device)
            self._sums[name].update(value * samples)
            self._samples[name].update(samples)

    def take(self) -> dict[str, Tensor]:
        """Return the means over what all processes added, and start anew. Every process must call this."""
        means = {name: total.compute() / self._samples[name].compute() for name, total in self._sums.items()}
        self._sums, self._samples = {}, {}
        return means
