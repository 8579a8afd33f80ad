"""Hand-made features of windows of readings."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from repdib_lightning.encoders.running_standardisation import RunningStandardisation

STATISTICS = 8
"""Numbers for each channel."""


class WindowStatistics(nn.Module):
    """Statistics of each channel (:func:`window_statistics`), standardised over the windows of the training.

    Args:
        inputs: X.
    """

    def __init__(self, inputs: int) -> None:
        super().__init__()
        self.width = STATISTICS * inputs
        self.standardise = RunningStandardisation(self.width)

    def forward(self, windows: Tensor, observed: Tensor) -> Tensor:
        """(n, X, window), which may have NaN, and which windows count, (n,) bool, to (n, 8 X)."""
        return self.standardise(window_statistics(windows), observed)


def window_statistics(windows: Tensor) -> Tensor:
    """(..., X, T) to (..., 8 X): mean, deviation, least, quartiles, most and mean size of a step of each channel.

    Of what is finite; zeros where nothing is. A step is the difference of two readings that follow each other.
    """
    shares = torch.tensor([0.0, 0.25, 0.5, 0.75, 1.0], dtype=windows.dtype, device=windows.device)
    order = windows.nanquantile(shares, dim=-1).unbind(0)
    mean = windows.nanmean(-1)
    deviation = (windows - mean.unsqueeze(-1)).square().nanmean(-1).sqrt()
    steps = windows.diff(dim=-1).abs().nanmean(-1)
    return torch.stack([mean, deviation, *order, steps], dim=-1).nan_to_num(0.0, 0.0, 0.0).flatten(-2)
