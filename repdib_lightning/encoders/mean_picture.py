"""Pictures as what differs from their mean."""

from __future__ import annotations

import torch
from torch import Tensor

from repdib_lightning.bottlenecks.precision import SinglePrecision
from repdib_lightning.encoders.views import centred
from repdib_lightning.processes import sum_over_processes


class MeanPicture(SinglePrecision):
    """Subtract from each pixel its mean over all pictures that were seen in training, on all processes.

    What stands still, such as the court of a game, becomes zero, and a small thing that moves on it stands out. Deep Q
    networks and the Decision Transformer leave it in; a multi-step inverse model on Breakout then predicts the most
    frequent action, and nothing else, for over a thousand updates (``docs/atari.md``).

    Args:
        shape: (C, H, W) of the pictures.
    """

    count: Tensor
    mean: Tensor

    def __init__(self, shape: tuple[int, ...]) -> None:
        super().__init__()
        self.register_buffer("count", torch.zeros(()))
        mean = torch.zeros(1, *shape).contiguous(memory_format=torch.channels_last)  # the order of what it is taken off
        self.register_buffer("mean", mean)

    def forward(self, pictures: Tensor) -> Tensor:
        """(N, C, H, W) uint8 to the same in (-1, 1)."""
        rows = centred(pictures)
        if self.training:
            self._take_in(rows)
        return rows - self.mean.to(rows.dtype)

    @torch.no_grad()
    def _take_in(self, rows: Tensor) -> None:
        """Move the mean of all pictures by what this batch of all processes adds."""
        sums = sum_over_processes(rows.sum(0, dtype=self.mean.dtype))
        count = sum_over_processes(self.count.new_full((1,), len(rows)))[0]
        self.count.add_(count)
        self.mean.add_((sums / count - self.mean) * (count / self.count))
