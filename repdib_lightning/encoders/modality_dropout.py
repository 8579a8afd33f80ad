"""Modality dropout: training clips lose whole modalities, so that the others learn to do without."""

from __future__ import annotations

import torch
from torch import Tensor

from repdib_lightning.processes import own_rows, rows_of_all


def drop_modalities(present: Tensor, chance: float) -> Tensor:
    """Drop each present modality of each sample with this chance, but never the last: (N, n) bool to the same.

    Where all would go, one of those present stays, any with the same chance.
    """
    if chance == 0:
        return present
    drawn = own_rows(torch.rand(rows_of_all(len(present)), present.shape[1], device=present.device))
    kept = present & (drawn >= chance)
    last = drawn.masked_fill(~present, -1.0).argmax(1, keepdim=True)
    spared = torch.zeros_like(present).scatter(1, last, ~kept.any(1, keepdim=True)) & present
    return kept | spared
