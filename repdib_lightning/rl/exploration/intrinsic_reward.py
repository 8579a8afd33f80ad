"""The reward of an agent without a task: how far what it reaches is from what it has seen."""

from __future__ import annotations

from typing import Literal

import torch
from torch import Tensor

from repdib_lightning.bottlenecks.precision import SinglePrecision, without_autocast
from repdib_lightning.errors import UserError, nearest

_DUPLICATES = ("keep", "distinct", "count")
_DISTANCES = ("euclidean", "hamming")
_ROUNDING = 1e-14
"""Squared distances below this share of both squared lengths are 0: in float64, rounding alone leaves as much."""


class NearestNeighbourReward(SinglePrecision):
    """Distance to the k-th nearest of the embeddings in a queue (ProtoRL, Yarats et al. 2021, and its published
    program).

    At each call the candidates enter the queue first, in place of the oldest, then all rows are measured: a candidate
    finds itself. Only rows that have been filled count, where the published queue starts with zeros. Where fewer than k
    rows (or different rows) are there, the farthest of them counts; 0 where there is none. No gradient.

    Behind a quantiser there are at most L^G embeddings, and equal ones are common. What becomes of them:

    - ``keep``: each copy is a neighbour, as published. What is in the queue k times is worth exactly 0, seen three
      times or a thousand: among what is common nothing is better than anything else.
    - ``distinct``: copies are merged, and the k-th nearest different row counts (its own among them, at distance 0).
      How often something was seen then means nothing: a lone, far off one pays the same for ever.
    - ``count``: that distance over the square root of the number of copies of the row itself in the queue, at least 1
      (the bonus of counts, Strehl and Littman 2008; Bellemare et al. 2016). The default: a reward that seeks entropy
      must fall where the agent has often been, and must not be flat there. Without copies it is the published reward.

    What is the same: rows that are equal number for number or, with ``groups``, those of equal codes. Give the codes
    where encoder and predictor are trained meanwhile: the embedding of the same code moves with each step, so that its
    older copies in the queue are near but not equal. A code is then as far as its nearest copy. A row without codes,
    where a quantiser has not started, is the same as no other.

    The queue is of this process alone.

    Args:
        width: P, of the embeddings; G where these are codes.
        queue: Q, rows that are kept.
        neighbours: k.
        duplicates: ``keep``, ``distinct`` or ``count``.
        distance: ``euclidean``, exact to about 1e-7 of the rows' length; ``hamming``: share of the numbers that differ,
            for rows of G codes.
        groups: G of the codes that are given beside the embeddings; 0 for none.

    Attributes:
        width: P.
        rows: (Q, P), the queue.
        codes: (Q, G) int64, theirs, -1 where unknown; (Q, 0) without ``groups``.
        filled, position: () int64, rows that count, and where the next one goes.

    Raises:
        UserError: an unknown choice, or an option out of range.
    """

    rows: Tensor
    codes: Tensor
    filled: Tensor
    position: Tensor

    def __init__(
        self,
        width: int,
        *,
        queue: int = 2048,
        neighbours: int = 3,
        duplicates: Literal["keep", "distinct", "count"] = "count",
        distance: Literal["euclidean", "hamming"] = "euclidean",
        groups: int = 0,
    ) -> None:
        super().__init__()
        for name, choice, choices in (("duplicates", duplicates, _DUPLICATES), ("distance", distance, _DISTANCES)):
            if choice not in choices:
                raise UserError(f"NearestNeighbourReward: unknown {name} '{choice}', {nearest(choice, choices)}")
        if queue < 1:
            raise UserError(f"NearestNeighbourReward: queue must be at least 1, is {queue}")
        if not 1 <= neighbours <= queue:
            raise UserError(f"NearestNeighbourReward: neighbours must be in 1..{queue} (the queue), is {neighbours}")
        self.width = width
        self.neighbours, self.duplicates, self.distance = neighbours, duplicates, distance
        self.register_buffer("rows", torch.zeros(queue, width))
        self.register_buffer("codes", torch.zeros(queue, groups, dtype=torch.int64))
        self.register_buffer("filled", torch.zeros((), dtype=torch.int64))
        self.register_buffer("position", torch.zeros((), dtype=torch.int64))

    @torch.no_grad()
    def forward(self, embeddings: Tensor, candidates: Tensor, codes: Tensor | None = None) -> Tensor:
        """Take the candidates into the queue and measure every row.

        Args:
            embeddings: (B, P).
            candidates: (n,) int64, rows of the batch to enqueue; one may come more than once.
            codes: (B, G) int64, with ``groups`` only; None where there are none yet.

        Returns:
            Rewards (B,), in the queue's dtype.
        """
        with without_autocast(embeddings):
            embeddings, codes = self._as_kept(embeddings, codes)
            self._enqueue(embeddings[candidates], codes[candidates])
            distances = self._distances(embeddings).masked_fill_(~self._used(), torch.inf)
            if self.duplicates == "keep":
                return self._farthest_of_nearest(distances)
            queued, own, kinds = self._same(embeddings, codes)
            merged = distances.new_full((len(distances), kinds + 1), torch.inf)
            merged.scatter_reduce_(1, queued.expand_as(distances), distances, "amin")
            rewards = self._farthest_of_nearest(merged)
            if self.duplicates == "count":
                copies = torch.bincount(queued, minlength=kinds + 1)[own]
                rewards /= copies.clamp_min(1).sqrt()
            return rewards

    @torch.no_grad()
    def duplicated(self, embeddings: Tensor, codes: Tensor | None = None) -> Tensor:
        """Share of the rows (B, P) that stand in the queue, (). Ask before the call, which puts some of them there."""
        queued, own, kinds = self._same(*self._as_kept(embeddings, codes))
        copies = torch.bincount(queued, minlength=kinds + 1)[own]
        return (copies > 0).to(self.rows.dtype).mean()

    def _as_kept(self, embeddings: Tensor, codes: Tensor | None) -> tuple[Tensor, Tensor]:
        """In the queue's types, with codes of some kind."""
        if codes is None:
            codes = self.codes.new_full((len(embeddings), self.codes.shape[1]), -1)
        assert embeddings.shape[1:] == self.rows.shape[1:] and codes.shape[1:] == self.codes.shape[1:]
        return embeddings.to(self.rows.dtype), codes.to(self.codes.dtype)

    def _enqueue(self, rows: Tensor, codes: Tensor) -> None:
        size, count = len(self.rows), len(rows)
        kept = min(size, count)
        places = (self.position + torch.arange(count - kept, count, device=rows.device)) % size
        self.rows[places], self.codes[places] = rows[count - kept :], codes[count - kept :]
        self.position.add_(count).remainder_(size)
        self.filled.add_(count).clamp_(max=size)

    def _used(self) -> Tensor:
        """Which rows of the queue count, (Q,) bool."""
        return torch.arange(len(self.rows), device=self.rows.device) < self.filled

    def _distances(self, embeddings: Tensor) -> Tensor:
        """From (B, P) to the queue, (B, Q)."""
        if self.distance == "hamming":
            return torch.cdist(embeddings, self.rows, p=0) / self.rows.shape[1]
        # By a matrix product, which is many times as fast as differences, but in float64: in float32 its rounding is as
        # large as the distance between what is close.
        left, right = embeddings.double(), self.rows.double()
        lengths = left.square().sum(1, keepdim=True) + right.square().sum(1)
        squares = torch.addmm(lengths, left, right.T, alpha=-2)
        return squares.masked_fill_(squares < _ROUNDING * lengths, 0.0).sqrt_().to(self.rows.dtype)

    def _farthest_of_nearest(self, distances: Tensor) -> Tensor:
        """The k-th smallest of each row of (B, n), or the largest that is finite where fewer are."""
        smallest = distances.topk(min(self.neighbours, distances.shape[1]), largest=False).values
        return smallest.masked_fill(smallest.isinf(), 0.0).amax(1)

    def _same(self, embeddings: Tensor, codes: Tensor) -> tuple[Tensor, Tensor, int]:
        """Number the n different rows: of the queue (Q,), n itself where unfilled; of the batch (B,); and n."""
        everything = torch.cat([self.rows, embeddings])
        if self.codes.shape[1]:
            everything = torch.cat([self.codes, codes])
            first, others = everything[:, 0], torch.arange(len(everything), device=everything.device)
            everything[:, 0] = torch.where(first < 0, -1 - others, first)
        different, numbers = torch.unique(everything, dim=0, return_inverse=True)
        queued, own = numbers[: len(self.rows)], numbers[len(self.rows) :]
        return queued.masked_fill(~self._used(), len(different)), own, len(different)
