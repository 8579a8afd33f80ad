"""One vector of the steps of a clip."""

from __future__ import annotations

from torch import Tensor, nn

from repdib_lightning.encoders.clip_steps import masked_shares
from repdib_lightning.encoders.self_attention import MaskedSelfAttention


class KeylessPooling(nn.Module):
    """Keyless attention (Long et al. 2018): e_t = w^T h_t, lambda = softmax over steps, c = sum of lambda_t h_t.

    Args:
        width: d.
    """

    def __init__(self, width: int) -> None:
        super().__init__()
        self.score = nn.Linear(width, 1, bias=False)

    def forward(self, steps: Tensor, observed: Tensor) -> tuple[Tensor, Tensor]:
        """(N, T, d) and (N, T) bool to (N, d), and the weights (N, T): sum 1 over what was observed."""
        shares = masked_shares(self.score(steps).squeeze(-1), observed)
        return (shares.unsqueeze(-1) * steps).sum(1), shares


class AttentionPooling(nn.Module):
    """HAMLET's unimodal attention (section III-B): multi-head self-attention over time, then the mean over steps.

    HAMLET takes the sum; the mean does not depend on how long a clip is.

    Args:
        width: d.
        heads: must divide d.
    """

    def __init__(self, width: int, heads: int) -> None:
        super().__init__()
        self.attention = MaskedSelfAttention(width, heads)

    def forward(self, steps: Tensor, observed: Tensor) -> tuple[Tensor, Tensor]:
        """(N, T, d) and (N, T) bool to (N, d), and the attention each step receives, (N, T)."""
        attended, received = self.attention(steps, observed)
        return attended.sum(1) / observed.sum(1, keepdim=True).clamp_min(1), received
