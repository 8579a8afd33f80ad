"""Agreement between the processes of a distributed run, decided at call time: a single process does nothing.

A quantiser may be built before or after the process group, so nothing here is remembered from construction.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor, distributed
from torch.autograd.function import once_differentiable


def several_processes() -> bool:
    """Whether more than one process trains at this moment."""
    return distributed.is_available() and distributed.is_initialized() and distributed.get_world_size() > 1


def process_count() -> int:
    """Number of processes that train at this moment."""
    return distributed.get_world_size() if several_processes() else 1


def sum_over_processes(tensor: Tensor) -> Tensor:
    """Add the tensors of all processes, in place, and return it."""
    if several_processes():
        distributed.all_reduce(tensor)
    return tensor


def take_from_first(tensor: Tensor) -> Tensor:
    """Overwrite the tensor by that of process 0, in place, and return it."""
    if several_processes():
        distributed.broadcast(tensor, src=0)
    return tensor


def gather_rows(rows: Tensor) -> Tensor:
    """Concatenate (N_p, ...) over the processes p, in their order; N_p may differ."""
    if not several_processes():
        return rows
    counts = rows.new_zeros(distributed.get_world_size(), dtype=torch.int64)
    counts[distributed.get_rank()] = len(rows)
    distributed.all_reduce(counts)
    padded = rows.new_zeros(int(counts.max()), *rows.shape[1:])
    padded[: len(rows)] = rows
    parts = [torch.empty_like(padded) for _ in range(len(counts))]
    distributed.all_gather(parts, padded)
    return torch.cat([part[:count] for part, count in zip(parts, counts.tolist(), strict=True)])


def rows_of_all(count: int) -> int:
    """How many rows all processes have, where this one has ``count`` and each has as many."""
    return count * process_count()


def own_rows(drawn: Tensor, dim: int = 0) -> Tensor:
    """Cut the share of this process out of what was drawn for the rows of all.

    Noise belongs to the sample, not to the process: each draws the noise of the whole batch from the same generator
    state and keeps its own part, so that several processes train on what one would have trained on.
    """
    if not several_processes():
        return drawn
    return drawn.tensor_split(distributed.get_world_size(), dim)[distributed.get_rank()]


def pick_rows(rows: Tensor, wanted: Tensor) -> Tensor:
    """Rows at ``wanted`` (K,) int64, counted through the equally many rows (R, ...) of each process: (K, ...).

    All processes must want the same.
    """
    if not several_processes():
        return rows[wanted]
    here = wanted - distributed.get_rank() * len(rows)
    held = (here >= 0) & (here < len(rows))
    picked = rows[here.clamp(0, len(rows) - 1)].masked_fill(~held.view(-1, *[1] * (rows.ndim - 1)), 0.0)
    return sum_over_processes(picked)


def gather_with_gradients(rows: Tensor, *, equal: bool) -> tuple[Tensor, Tensor]:
    """Rows (B, ...) of all processes in their order, (N, ...), and where this one's stand among them, (B,) int64.

    Gradients reach the rows of every process from the losses of all of them.

    Args:
        rows: of this process.
        equal: each process has as many rows; then nothing but the rows is exchanged.
    """
    own = torch.arange(rows.shape[0], device=rows.device)  # not len(), which a traced batch has none of
    if not several_processes():
        return rows, own
    rank = distributed.get_rank()
    before = rank * len(rows) if equal else (gather_rows(torch.full_like(own, rank)) < rank).sum()
    places = own + before
    gathered: Tensor = _RowsOfAll.apply(rows, places, equal)
    return gathered, places


class _RowsOfAll(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, rows: Tensor, places: Tensor, equal: bool) -> Tensor:
        ctx.save_for_backward(places)
        rows = rows.contiguous()
        if not equal:
            return gather_rows(rows)
        parts = [torch.empty_like(rows) for _ in range(process_count())]
        distributed.all_gather(parts, rows)
        return torch.cat(parts)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor, None, None]:
        (places,) = ctx.saved_tensors
        return sum_over_processes(gradients[0].clone(memory_format=torch.contiguous_format))[places], None, None
