"""The codes of a quantiser, how they follow the data, and how dead ones come back."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Literal

import torch
from torch import Tensor, nn

from repdib_lightning.bottlenecks.kmeans import nearest_codes
from repdib_lightning.bottlenecks.precision import SinglePrecision
from repdib_lightning.bottlenecks.processes import sum_over_processes, take_from_first
from repdib_lightning.errors import UserError

_SMOOTHING = 1e-5


class Codebook(SinglePrecision):
    """P books of L codes of width D: P = G, or 1 where all groups share one book.

    Rows are (R, P, D) throughout: R = N where each group has its own book, R = N * G where one is shared.

    Two rules: ``gradient`` makes the codes a parameter that a loss pulls to the data (VQ-VAE, van den Oord et al. 2017,
    eq. 3); ``ema`` keeps running sums and counts of the rows that chose each code (same paper, appendix A.1), summed
    over all processes at each step, float32 whatever the precision of the network.

    A code that no row of any process has chosen for ``revive_after`` training steps is moved onto a random row of the
    batch of process 0. Its sum and count are set to that row, so that the update of the same step and of those after
    it continue from there. 0 switches this off.

    Attributes:
        vectors: (P, L, D), parameter or buffer.
        sizes: (P, L), running number of rows a step that chose the code (``ema``).
        sums: (P, L, D), running sum of those rows a step (``ema``).
        idle: (P, L) int64, training steps since the code was last chosen.
    """

    sizes: Tensor
    sums: Tensor
    idle: Tensor
    first: Tensor

    def __init__(
        self, books: int, codes: int, size: int, *, rule: Literal["ema", "gradient"], decay: float, revive_after: int
    ) -> None:
        super().__init__()
        self.rule, self.decay, self.revive_after = rule, decay, revive_after
        vectors = torch.randn(books, codes, size)
        if rule == "ema":
            self.vectors: Tensor
            self.register_buffer("vectors", vectors)
            self.register_buffer("sizes", torch.ones(books, codes))
            self.register_buffer("sums", vectors.clone())
        else:
            self.vectors = nn.Parameter(vectors)
        self.register_buffer("idle", torch.zeros(books, codes, dtype=torch.int64))
        self.register_buffer("first", torch.arange(books) * codes, persistent=False)

    @torch.no_grad()
    def assign(self, rows: Tensor) -> Tensor:
        """Index of the nearest code of each row, (R, P) int64."""
        return nearest_codes(rows.transpose(0, 1), self.vectors).transpose(0, 1)

    def look_up(self, indices: Tensor) -> Tensor:
        """The codes behind (R, P) indices, (R, P, D)."""
        flat = self.vectors.flatten(0, 1).index_select(0, (indices + self.first).flatten())
        return flat.view(*indices.shape, -1)

    @torch.no_grad()
    def place(self, centres: Tensor, shares: Tensor, rows: int) -> None:
        """Put the codes onto (P, L, D) centres that hold the given (P, L) shares of the rows of a step.

        Process 0 decides for all.
        """
        self.vectors.copy_(take_from_first(centres.contiguous()))
        self.idle.zero_()
        if self.rule == "ema":
            self.sizes.copy_(take_from_first((shares * rows).clamp(min=1.0)))
            self.sums.copy_(self.vectors * self.sizes.unsqueeze(-1))

    @torch.no_grad()
    def follow(self, rows: Tensor, indices: Tensor) -> None:
        """Update what a training step changes: running averages, idle times, dead codes."""
        if self.rule == "gradient" and not self.revive_after:
            return
        counts = self._tally(rows, indices)
        if self.revive_after:
            self._revive(rows, counts)

    def _tally(self, rows: Tensor, indices: Tensor) -> Tensor:
        """Count (P, L) the rows of all processes that chose each code, and move the ``ema`` codes by them."""
        books, codes, size = self.vectors.shape
        flat = (indices + self.first).flatten()
        ema = self.rule == "ema"
        tally = rows.new_zeros(books * codes, size + 1 if ema else 1)
        ones = rows.new_ones(len(flat), 1)
        tally.index_add_(0, flat, torch.cat([rows.reshape(-1, size), ones], dim=1) if ema else ones)
        tally = sum_over_processes(tally).view(books, codes, -1)
        counts = tally[..., -1]
        if ema:
            self.sizes.lerp_(counts, 1 - self.decay)
            self.sums.lerp_(tally[..., :-1], 1 - self.decay)
            total = self.sizes.sum(-1, keepdim=True)
            smooth = (self.sizes + _SMOOTHING) / (total + codes * _SMOOTHING) * total
            self.vectors.copy_(self.sums / smooth.unsqueeze(-1))
        return counts

    def _revive(self, rows: Tensor, counts: Tensor) -> None:
        codes = self.vectors.shape[1]
        self.idle.copy_(torch.where(counts > 0, 0, self.idle + 1))
        dead = self.idle >= self.revive_after
        drawn = torch.randperm(len(rows), device=rows.device)
        drawn = drawn[torch.arange(codes, device=rows.device) % len(rows)]
        fresh = take_from_first(rows[drawn].transpose(0, 1).contiguous())
        self.vectors.copy_(torch.where(dead.unsqueeze(-1), fresh, self.vectors))
        self.idle.masked_fill_(dead, 0)
        if self.rule == "ema":
            self.sizes.masked_fill_(dead, 1.0)
            self.sums.copy_(torch.where(dead.unsqueeze(-1), fresh, self.sums))

    def _load_from_state_dict(self, state_dict: Mapping[str, Any], prefix: str, *rest: Any) -> None:
        saved = state_dict.get(prefix + "vectors")
        if saved is not None:
            rule = "ema" if prefix + "sums" in state_dict else "gradient"
            if rule != self.rule:
                raise UserError(f"codebook: the saved one is '{rule}', the configuration says '{self.rule}'")
            if saved.shape != self.vectors.shape:
                raise UserError(
                    f"codebook: the saved one has {_describe(saved)}, the configuration asks for "
                    f"{_describe(self.vectors)} (see groups, codes, shared)"
                )
        super()._load_from_state_dict(state_dict, prefix, *rest)


def _describe(vectors: Tensor) -> str:
    books, codes, size = vectors.shape
    return f"{books} book{'s' if books > 1 else ''} of {codes} codes, {size} wide"


def count_codes(indices: Tensor, codes: int) -> Tensor:
    """Histogram per group: (N, G) indices -> (G, L) float."""
    groups = indices.shape[1]
    flat = (indices + torch.arange(groups, device=indices.device) * codes).flatten()
    counts = torch.zeros(groups * codes, device=indices.device)
    return counts.index_add_(0, flat, torch.ones_like(flat, dtype=counts.dtype)).view(groups, codes)


def perplexity(counts: Tensor) -> Tensor:
    """How many codes each group uses effectively, exp of the entropy: (G, L) counts -> (G,) in [1, L]."""
    shares = counts / counts.sum(-1, keepdim=True).clamp(min=1)
    entropy: Tensor = torch.special.entr(shares).sum(-1)
    return entropy.exp()
