"""Features as an agent sees them: brought to mean 0 and deviation 1 by running averages."""

from __future__ import annotations

import torch
from torch import Tensor, nn

_RATE = 0.01
_LEAST = 1e-4


class RunningStatistics(nn.Module):
    """Subtracts running means and divides by running deviations, of at least 0.01; latents are of size 1.

    Args:
        features: M.
    """

    mean: Tensor
    variance: Tensor
    begun: Tensor

    def __init__(self, features: int) -> None:
        super().__init__()
        self.register_buffer("mean", torch.zeros(features))
        self.register_buffer("variance", torch.ones(features))
        self.register_buffer("begun", torch.zeros(()))

    def forward(self, features: Tensor) -> Tensor:
        """(B, M) to (B, M)."""
        return (features - self.mean) * self.scale

    @property
    def scale(self) -> Tensor:
        """(M,): one over the deviations."""
        return (self.variance + _LEAST).rsqrt()

    @torch.no_grad()
    def take_in(self, features: Tensor) -> None:
        """Move the averages towards those of a batch (B, M), where these are finite; the first one sets them."""
        variance, mean = torch.var_mean(features.to(self.mean.dtype), dim=0, correction=0)
        sound = variance.isfinite()
        variance, mean = torch.where(sound, variance, self.variance), torch.where(sound, mean, self.mean)
        rate = torch.where(self.begun > 0, _RATE, 1.0)
        self.mean.lerp_(mean, rate)
        self.variance.lerp_(variance, rate)
        self.begun.fill_(1.0)
