"""One vector of those of several modalities, some of which may be missing."""

from __future__ import annotations

from torch import Tensor, nn

from repdib_lightning.encoders.clip_steps import masked_shares
from repdib_lightning.encoders.self_attention import MaskedSelfAttention
from repdib_lightning.errors import UserError, nearest

FUSIONS = ("attention", "keyless", "weighting")
JOINS = ("sum", "concat")


class Fusion(nn.Module):
    """(N, n, d) and which of the n modalities are present, (N, n) bool, to (N, width) and weights (N, n).

    What is missing weighs nothing, its vector is not looked at; the weights of the others have sum 1. Where all are
    missing the result is zeros.

    Args:
        width: d.
        modalities: n.
        join: ``sum``, of width d, or ``concat``, of width n * d.
    """

    def __init__(self, width: int, modalities: int, join: str) -> None:
        super().__init__()
        if join not in JOINS:
            raise UserError(f"MultimodalEncoder: unknown join '{join}', {nearest(join, JOINS)}")
        self.join = join
        self.width = width if join == "sum" else width * modalities

    def forward(self, vectors: Tensor, present: Tensor) -> tuple[Tensor, Tensor]:
        """Fuse, as the class says."""
        raise NotImplementedError

    def joined(self, vectors: Tensor) -> Tensor:
        """(N, n, d) to (N, width)."""
        return vectors.sum(1) if self.join == "sum" else vectors.flatten(1)


class AttentionFusion(Fusion):
    """HAMLET's multimodal attention (MAT, section III-C): multi-head self-attention over the axis of modalities.

    Args:
        width: d.
        modalities: n.
        join: see :class:`Fusion`.
        heads: must divide d.
    """

    def __init__(self, width: int, modalities: int, join: str, heads: int) -> None:
        super().__init__(width, modalities, join)
        self.attention = MaskedSelfAttention(width, heads)

    def forward(self, vectors: Tensor, present: Tensor) -> tuple[Tensor, Tensor]:
        """The weight of a modality is the attention that it receives."""
        attended, received = self.attention(vectors, present)
        return self.joined(attended), received


class KeylessFusion(Fusion):
    """Keyless attention over modalities: weights softmax(w^T c_m), as over time.

    Args:
        width: d.
        modalities: n.
        join: see :class:`Fusion`.
    """

    def __init__(self, width: int, modalities: int, join: str) -> None:
        super().__init__(width, modalities, join)
        self.score = nn.Linear(width, 1, bias=False)

    def forward(self, vectors: Tensor, present: Tensor) -> tuple[Tensor, Tensor]:
        """Weigh each modality by itself."""
        shares = masked_shares(self.score(vectors).squeeze(-1), present)
        return self.joined(shares.unsqueeze(-1) * vectors), shares


class WeightingFusion(Fusion):
    """The modality weighting of the paper's experiment, "modelled as a 1D-CNN".

    The paper says no more. Here a convolution of kernel 3 over the axis of modalities, with the d features as channels,
    gives one number each, and a softmax over those present the weights.

    Args:
        width: d.
        modalities: n.
        join: see :class:`Fusion`.
    """

    def __init__(self, width: int, modalities: int, join: str) -> None:
        super().__init__(width, modalities, join)
        self.score = nn.Conv1d(width, 1, 3, padding=1, bias=False)

    def forward(self, vectors: Tensor, present: Tensor) -> tuple[Tensor, Tensor]:
        """Weigh each modality by itself and its neighbours, of which the missing ones are zeros."""
        known = vectors.masked_fill(~present.unsqueeze(-1), 0.0)
        shares = masked_shares(self.score(known.transpose(1, 2)).squeeze(1), present)
        return self.joined(shares.unsqueeze(-1) * known), shares


def build_fusion(kind: str, width: int, modalities: int, *, join: str, heads: int) -> Fusion:
    """The fusion of this name.

    Raises:
        UserError: an unknown one, an unknown join, or heads that do not divide the width.
    """
    if kind not in FUSIONS:
        raise UserError(f"MultimodalEncoder: unknown fusion '{kind}', {nearest(kind, FUSIONS)}")
    if kind == "attention":
        return AttentionFusion(width, modalities, join, heads)
    return (KeylessFusion if kind == "keyless" else WeightingFusion)(width, modalities, join)
