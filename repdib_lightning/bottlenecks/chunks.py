"""How many rows to treat at once, so that they stay in the cache from one operation to the next."""

from __future__ import annotations

import torch
from torch import Tensor

_CHUNK_ELEMENTS = 2**18
"""For each thread of a CPU."""


def row_chunks(rows: Tensor) -> list[slice]:
    """Slices of (N, ...). One chunk on a GPU and under a compiler, which has no loop to unroll then."""
    count = rows.shape[0]
    if rows.device.type != "cpu" or torch.compiler.is_compiling():
        return [slice(0, count)]
    step = max(1, _CHUNK_ELEMENTS * torch.get_num_threads() // max(1, rows[:1].numel()))
    return [slice(start, min(start + step, count)) for start in range(0, count, step)]
