"""Dropout whose random numbers are cheap on a CPU, where torch's cost as much as a small transformer's products."""

from __future__ import annotations

import torch
from torch import Tensor, nn

_LEVELS = 1 << 16
"""Each element is kept or dropped by 16 random bits."""


def dropped(values: Tensor, share: float) -> Tensor:
    """Set a share of the elements to 0, at random, and scale the others so that the mean stays.

    On a CPU the share is rounded to 1 / 65536, below 1, and four elements share one draw of 64 bits of the global
    generator.

    Args:
        values: any shape. share: in [0, 1).
    """
    if values.device.type != "cpu":
        return torch.dropout(values, share, True)
    least = min(round(share * _LEVELS), _LEVELS - 1)
    if least == 0:
        return values
    count = values.numel()
    draws = torch.empty(-(-count // 4), dtype=torch.int64).random_(-(1 << 63), None)
    kept = draws.view(torch.int16)[:count].view(values.shape) >= least - _LEVELS // 2
    return values * (kept * (_LEVELS / (_LEVELS - least))).to(values.dtype)


class Dropout(nn.Module):
    """:func:`dropped` while training; nothing else. Args: share: in [0, 1)."""

    def __init__(self, share: float) -> None:
        super().__init__()
        self.share = share

    def forward(self, values: Tensor) -> Tensor:
        """Any shape to the same."""
        return dropped(values, self.share) if self.training else values
