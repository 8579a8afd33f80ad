"""The codes of a quantiser, how they follow the data, and how dead ones come back."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Literal

import torch
from torch import Tensor, nn

from repdib_lightning.bottlenecks.chunks import row_chunks
from repdib_lightning.bottlenecks.nearest import nearest_codes
from repdib_lightning.bottlenecks.precision import SinglePrecision
from repdib_lightning.errors import UserError
from repdib_lightning.processes import pick_rows, process_count, sum_over_processes, take_from_first

_SMOOTHING = 1e-5


class Codebook(SinglePrecision):
    """P books of L codes of width D: P = G, or 1 where all groups share one book.

    Rows are (R, P, D) throughout: R = N where each group has its own book, R = N * G where one is shared.

    Two rules: ``gradient`` makes the codes a parameter that a loss pulls to the data (VQ-VAE, van den Oord et al. 2017,
    eq. 3); ``ema`` keeps running sums and counts of the rows that chose each code (same paper, appendix A.1), summed
    over all processes at each step, float32 whatever the precision of the network.

    A code that no row of any process has chosen for ``revive_after`` training steps is moved onto a random row of the
    batch of all processes. Its sum and count are set to that row, so that the update of the same step and of those
    after it continue from there. 0 switches this off.

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

    def flat(self, indices: Tensor) -> Tensor:
        """(R, P) indices counted through all books, book * L + code: (R * P,)."""
        return (indices + self.first).flatten()

    def look_up(self, indices: Tensor) -> Tensor:
        """The codes behind (R, P) indices, (R, P, D)."""
        return self.vectors.flatten(0, 1).index_select(0, self.flat(indices)).view(*indices.shape, -1)

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
    def follow(self, rows: Tensor, chosen: Tensor, counts: Tensor) -> None:
        """Update what a training step changes: running averages, idle times, dead codes.

        Args:
            rows: (R, P, D) of this process, as all that follows.
            chosen: (R * P,), the code of each row, see :meth:`flat`.
            counts: (P, L), rows that chose each code.
        """
        if self.rule == "ema":
            counts = self._average(rows, chosen, counts)
        elif self.revive_after:
            counts = sum_over_processes(counts.clone())
        if self.revive_after:
            self._revive(rows, counts)

    def _average(self, rows: Tensor, chosen: Tensor, counts: Tensor) -> Tensor:
        """Move the codes by the rows of all processes, and return the counts of all processes."""
        books, codes, size = self.vectors.shape
        tally = rows.new_zeros(books * codes * (size + 1))  # in one piece, so that one exchange carries both
        sums, total = tally[: books * codes * size].view(-1, size), tally[books * codes * size :].view(books, codes)
        for part in row_chunks(rows):
            sums.index_add_(0, chosen[part.start * books : part.stop * books], rows[part].reshape(-1, size))
        total.copy_(counts)
        sum_over_processes(tally)
        self.sizes.lerp_(total, 1 - self.decay)
        self.sums.lerp_(sums.view_as(self.sums), 1 - self.decay)
        mass = self.sizes.sum(-1, keepdim=True)
        smooth = (self.sizes + _SMOOTHING) / (mass + codes * _SMOOTHING) * mass
        torch.div(self.sums, smooth.unsqueeze(-1), out=self.vectors)
        return total

    def _revive(self, rows: Tensor, counts: Tensor) -> None:
        codes = self.vectors.shape[1]
        self.idle.add_(1).masked_fill_(counts > 0, 0)
        dead = self.idle >= self.revive_after
        # A question to a GPU would wait for it, and one to a compiler would break its graph: they move what is dead,
        # be it nothing.
        if not torch.compiler.is_compiling() and dead.device.type == "cpu" and not dead.any():
            return
        drawn = torch.randperm(len(rows) * process_count(), device=rows.device)
        drawn = drawn[torch.arange(codes, device=rows.device) % len(drawn)]
        fresh = pick_rows(rows, take_from_first(drawn)).transpose(0, 1)
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


def describe_use(counts: Tensor) -> dict[str, Tensor]:
    """Metrics of a (G, L) histogram: perplexity (mean and lowest over groups), and used codes (mean over groups)."""
    effective = perplexity(counts)
    return {
        "perplexity": effective.mean(),
        "perplexity_min": effective.min(),
        "used_codes": (counts > 0).sum(-1, dtype=counts.dtype).mean(),
    }
