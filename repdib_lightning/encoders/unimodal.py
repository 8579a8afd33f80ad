"""One modality of a clip as one vector."""

from __future__ import annotations

from torch import Tensor, nn

from repdib_lightning.encoders.temporal_pooling import AttentionPooling, KeylessPooling
from repdib_lightning.errors import UserError, nearest

POOLINGS = ("attention", "keyless")


class UnimodalEncoder(nn.Module):
    """A sequence of step vectors, pooled over time and normalised (LayerNorm), so that all modalities weigh alike.

    Args:
        sequence: observation -> (N, T', d) and (N, T') bool.
        width: d.
        pooling: ``attention`` or ``keyless``.
        heads: of attention.

    Raises:
        UserError: an unknown pooling, or heads that do not divide the width.
    """

    def __init__(self, sequence: nn.Module, width: int, *, pooling: str, heads: int) -> None:
        super().__init__()
        if pooling not in POOLINGS:
            raise UserError(f"MultimodalEncoder: unknown pooling '{pooling}', {nearest(pooling, POOLINGS)}")
        self.sequence = sequence
        self.pooling = AttentionPooling(width, heads) if pooling == "attention" else KeylessPooling(width)
        self.norm = nn.LayerNorm(width)

    def forward(self, observation: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """(N, T, ...) to the vector (N, d), whether anything was observed (N,) bool, and the steps' weights (N, T')."""
        steps, observed = self.sequence(observation)
        pooled, weights = self.pooling(steps, observed)
        return self.norm(pooled), observed.any(1), weights
