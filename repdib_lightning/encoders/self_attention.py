"""Multi-head self-attention among what was observed."""

from __future__ import annotations

import math

from torch import Tensor, nn

from repdib_lightning.encoders.clip_steps import masked_shares, zero_unobserved
from repdib_lightning.errors import UserError


class MaskedSelfAttention(nn.Module):
    """Multi-head self-attention (Vaswani et al. 2017, section 3.2.2) in which what is missing neither asks nor answers.

    The same as ``nn.MultiheadAttention`` with a padding mask on what was observed. Rows in which nothing was observed
    give zeros, where that one gives NaN.

    Args:
        width: d.
        heads: must divide d.

    Raises:
        UserError: heads that do not divide the width.
    """

    def __init__(self, width: int, heads: int) -> None:
        super().__init__()
        if heads < 1 or width % heads:
            raise UserError(f"MultimodalEncoder: heads {heads} must divide the width {width}")
        self.heads = heads
        self.inputs = nn.Linear(width, 3 * width)
        self.output = nn.Linear(width, width)
        nn.init.xavier_uniform_(self.inputs.weight)
        nn.init.zeros_(self.inputs.bias)
        nn.init.zeros_(self.output.bias)

    def forward(self, vectors: Tensor, observed: Tensor) -> tuple[Tensor, Tensor]:
        """(N, T, d) and (N, T) bool to (N, T, d), and the attention that each receives.

        The attention, (N, T), is the mean over heads and over those that ask: with sum 1 over what was observed.
        """
        asked, keys, values = self.inputs(vectors).unflatten(-1, (3, self.heads, -1)).permute(2, 0, 3, 1, 4)
        scores = asked @ keys.transpose(-1, -2) / math.sqrt(keys.shape[-1])  # (N, heads, T, T)
        shares = masked_shares(scores, observed[:, None, None, :])
        attended = (shares @ values).transpose(1, 2).flatten(2)
        asking = observed.to(shares.dtype).unsqueeze(-1)
        received = (shares.mean(1) * asking).sum(1) / asking.sum(1).clamp_min(1)
        return zero_unobserved(self.output(attended), observed), received
