"""What the contrastive objectives share: which future belongs to which anchor, among those of the whole batch."""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor, distributed
from torch.autograd.function import once_differentiable

from repdib_lightning.bottlenecks.precision import at_least_single, without_autocast
from repdib_lightning.errors import UserError
from repdib_lightning.objectives.base import Encode, Objective
from repdib_lightning.processes import gather_rows, process_count, several_processes, sum_over_processes
from repdib_lightning.records import Batch, ObjectiveOutput

TIE = 1e-5
"""Scores that differ by less, in nats, count as equal."""


class TemporalContrast(Objective):
    """Recognise an anchor's future among the futures of the batch (InfoNCE, van den Oord et al. 2018, equation 4).

    Subclasses say what an anchor and a future are described by, and how a pair is scored. Each of the F - 1 future
    indices is a classification of its own: the B anchors choose among the B futures of the same index. Where several
    processes train, the candidates are those of all of them, with gradients, so that the mean over the processes of
    their losses is the loss of the global batch. All frames are encoded in one pass.

    A future of another anchor counts as wrong even where it shows the same state. That is no error: with negatives
    drawn from the marginal distribution the best score is log p(future | anchor) / p(future), up to a term of the
    anchor alone, and a frequent state is held against it in proportion. It caps the accuracy below 1, no more.

    Losses: ``contrast``, in nats. Metrics: ``contrast_accuracy``, how often the right future scores highest (one of n
    that tie counts 1 / n), and ``contrast_nats`` = log(candidates) - loss, a lower bound on the mutual information of
    anchor and future which cannot exceed log(candidates); compare it between batches of one size. A lone candidate is
    always right and its loss is 0: harmless where held-out samples end in such a batch, refused in training.
    """

    def describe_anchors(self, latents: Tensor, actions: Tensor | None) -> Tensor:
        """Anchors (B, M) and the actions taken there to (B, H)."""
        raise NotImplementedError

    def describe_futures(self, latents: Tensor) -> Tensor:
        """Futures (..., M) to (..., H)."""
        raise NotImplementedError

    def score(self, products: Tensor) -> Tensor:
        """Logits of pairs from the inner products of their descriptions, elementwise."""
        raise NotImplementedError

    def forward(self, batch: Batch, encode: Encode) -> ObjectiveOutput:
        """Encode (B, F) frames once and let the anchors choose among the futures of each index.

        Raises:
            UserError: training on a single candidate.
        """
        latents = encode(batch.observations)
        anchors = self.describe_anchors(latents[:, 0], batch.actions)
        # Shares of a training batch are equal; only held-out ones need their sizes exchanged, which waits for a GPU.
        candidates, places = candidates_of_all(self.describe_futures(latents[:, 1:]), equal=self.training)
        if self.training and len(candidates) == 1:
            raise UserError(
                f"data.batch_size is 1: {type(self).__name__} tells the futures of a batch apart and needs at least 2"
            )
        with without_autocast(latents):
            precise = at_least_single(anchors.dtype)
            products = torch.einsum("bh,nfh->fbn", anchors.to(precise), candidates.to(precise))
            return recognition(self.score(products), places)


def recognition(scores: Tensor, places: Tensor) -> ObjectiveOutput:
    """Mean cross-entropy of choosing the right candidate, and its metrics.

    Args:
        scores: (F - 1, B, N), logits of each anchor for each of the N candidates of an index.
        places: (B,) int64, where each anchor's own future stands among them.
    """
    right = places.expand(scores.shape[:2])
    loss = -scores.log_softmax(-1).gather(-1, right[..., None]).mean()
    # Equal codes score equally up to rounding; neither that nor the candidates' order may decide between them.
    highest = scores.detach() >= scores.detach().amax(-1, keepdim=True) - TIE
    accuracy = (highest.gather(-1, right[..., None]).squeeze(-1) / highest.sum(-1)).mean()
    nats = math.log(scores.shape[-1]) - loss.detach()
    return ObjectiveOutput({"contrast": loss}, {"contrast_accuracy": accuracy, "contrast_nats": nats})


def candidates_of_all(rows: Tensor, *, equal: bool) -> tuple[Tensor, Tensor]:
    """Rows (B, ...) of all processes in their order, (N, ...), and where this one's stand among them, (B,) int64.

    Gradients reach the rows of every process from the losses of all of them.

    Args:
        rows: of this process.
        equal: each process has as many rows; then nothing but the rows is exchanged.
    """
    own = torch.arange(len(rows), device=rows.device)
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
