"""Where the latents of a batch lie, and how far apart: the scale by which errors of prediction are measured."""

from __future__ import annotations

import torch
from torch import Tensor

from repdib_lightning.processes import sum_over_processes

_LEAST_SHARE = 1e-8
"""The spread counts as at least this share of the mean square: equal rows differ by rounding."""


@torch.no_grad()
def centre_and_spread(rows: Tensor) -> tuple[Tensor, Tensor]:
    """Mean (M,) of (B, M) over the rows of all processes, and the mean squared distance from it, summed over M.

    No gradient, and never 0. Processes may have different numbers of rows.
    """
    count = sum_over_processes(torch.ones_like(rows[:, :1]).sum())
    centre = sum_over_processes(rows.sum(0)) / count
    sums = torch.stack([(rows - centre).square().sum(), rows.square().sum()])
    spread, size = sum_over_processes(sums) / count
    return centre, torch.maximum(spread, _LEAST_SHARE * size).clamp_min(torch.finfo(rows.dtype).tiny)
