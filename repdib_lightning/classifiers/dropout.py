"""Dropout that several processes draw as one would."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from repdib_lightning.errors import UserError
from repdib_lightning.processes import own_rows, rows_of_all


class SampleDropout(nn.Module):
    """``nn.Dropout`` of (N, M) whose draws belong to the samples, however many processes share the batch.

    Args:
        share: of the numbers that are set to 0 in training, from 0 to below 1.
        owner: who asks, for the message.
    """

    def __init__(self, share: float, owner: str) -> None:
        super().__init__()
        if not 0.0 <= share < 1.0:
            raise UserError(f"{owner}: dropout must be at least 0 and below 1, is {share}")
        self.share = share

    def forward(self, latents: Tensor) -> Tensor:
        """Drop some of (N, M), and scale up the others."""
        if not self.training or not self.share:
            return latents
        drawn = own_rows(torch.rand(rows_of_all(latents.shape[0]), latents.shape[1], device=latents.device))
        return latents * (drawn >= self.share) / (1.0 - self.share)
