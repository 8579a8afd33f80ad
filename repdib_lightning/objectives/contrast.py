"""What the contrastive objectives share: which future belongs to which anchor, among those of the whole batch."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from repdib_lightning.bottlenecks.precision import at_least_single, without_autocast
from repdib_lightning.objectives.base import Encode, Objective, drawn, require_futures, require_several
from repdib_lightning.processes import gather_with_gradients
from repdib_lightning.records import Batch, DataSpec, ObjectiveOutput

TIE = 1e-5
"""Scores that differ by less, in nats, count as equal."""


class TemporalContrast(Objective):
    """Recognise an anchor's future among the futures of the batch (InfoNCE, van den Oord et al. 2018, equation 4).

    Subclasses say what an anchor and a future are described by, and how a pair is scored. Each drawn future
    index is a classification of its own: the B anchors choose among the B futures of the same index. Where several
    processes train, the candidates are those of all of them, with gradients, so that the mean over the processes of
    their losses is the loss of the global batch. All frames are encoded in one pass.

    A future of another anchor counts as wrong even where it shows the same state. That is no error: with negatives
    drawn from the marginal distribution the best score is log p(future | anchor) / p(future), up to a term of the
    anchor alone, and a frequent state is held against it in proportion. It caps the accuracy below 1, no more.

    Losses: ``contrast``, in nats. Metrics: ``contrast_accuracy``, how often the right future scores highest (one of n
    that tie counts 1 / n), and ``contrast_nats`` = log(candidates) - loss, a lower bound on the mutual information of
    anchor and future which cannot exceed log(candidates); compare it between batches of one size. A lone candidate is
    always right and its loss is 0: harmless where held-out samples end in such a batch, refused in training.

    Args:
        spec: which frames of a sample are drawn futures.

    Raises:
        UserError: samples without futures.
    """

    def __init__(self, spec: DataSpec) -> None:
        super().__init__()
        require_futures(type(self).__name__, spec)
        self.spec = spec

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
        futures, _ = drawn(batch, latents, self.spec)
        anchors = self.describe_anchors(latents[:, 0], batch.actions)
        # Shares of a training batch are equal; only held-out ones need their sizes exchanged, which waits for a GPU.
        candidates, places = gather_with_gradients(self.describe_futures(futures), equal=self.training)
        require_several(self, len(candidates), "tells the futures of a batch apart")
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
