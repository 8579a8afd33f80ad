"""Features brought to mean 0 and deviation 1."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from repdib_lightning.processes import sum_over_processes


class RunningStandardisation(nn.Module):
    """Subtract the mean and divide by the deviation of all rows that were seen in training, on all processes.

    A row never depends on the others of its batch, but through these. Features that do not vary are divided by 1.

    Args:
        features: F.
    """

    count: Tensor
    mean: Tensor
    squares: Tensor

    def __init__(self, features: int) -> None:
        super().__init__()
        self.register_buffer("count", torch.zeros(()))
        self.register_buffer("mean", torch.zeros(features))
        self.register_buffer("squares", torch.zeros(features))  # of the distances from the mean, their sum

    def forward(self, rows: Tensor, observed: Tensor) -> Tensor:
        """(N, F) and which rows count, (N,) bool, to (N, F)."""
        if self.training:
            self._take_in(rows.detach(), observed)
        deviation = (self.squares / self.count.clamp_min(1)).sqrt()
        return (rows - self.mean) / torch.where(deviation > 1e-6, deviation, 1.0)

    @torch.no_grad()
    def _take_in(self, rows: Tensor, observed: Tensor) -> None:
        """Merge the moments of two parts (Chan et al. 1979): what was seen before, and this batch of all processes."""
        unobserved = ~observed.unsqueeze(-1)
        rows = rows.to(self.mean.dtype).masked_fill(unobserved, 0.0)
        sums = sum_over_processes(torch.cat([rows.sum(0), observed.sum().to(rows.dtype)[None]]))
        count = sums[-1]
        mean = sums[:-1] / count.clamp_min(1)
        squares = sum_over_processes((rows - mean).masked_fill(unobserved, 0.0).square().sum(0))
        share = count / (self.count + count).clamp_min(1)
        self.squares.add_(squares + (mean - self.mean).square() * self.count * share)
        self.mean.add_((mean - self.mean) * share)
        self.count.add_(count)
