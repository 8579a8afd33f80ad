"""Causal attention of tokens on themselves, on those before them, and on those of a cache."""

from __future__ import annotations

import math

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from repdib_lightning.rl.decision_transformer.cache import LayerCache
from repdib_lightning.rl.decision_transformer.dropout import Dropout, dropped

_PART = 30
"""Queries at a time where attention is written out: no key behind the last of them is looked at."""


class CausalAttention(nn.Module):
    """Multi-head attention of each token on itself and those before it.

    Args:
        width: of the tokens. heads: which share it. dropout: of the attention's weights and of what is returned.
    """

    def __init__(self, width: int, heads: int, dropout: float) -> None:
        super().__init__()
        self.width, self.heads, self.dropout = width, heads, dropout
        self.inputs, self.outputs = nn.Linear(width, 3 * width), nn.Linear(width, width)
        self.residual_dropout = Dropout(dropout)

    def forward(self, hidden: Tensor, cache: LayerCache | None = None, wanted: slice | None = None) -> Tensor:
        """(B, n, width) to (B, m, width).

        Args:
            hidden: the tokens. cache: keys and values of those before; these are added. wanted: which m of the n tokens
                to return; all by default.
        """
        past = 0 if cache is None else cache.length
        queries, keys, values = self._split(hidden, wanted)
        if cache is not None:
            keys, values = cache.extend(keys, values)
        places = torch.arange(past, past + hidden.shape[1], device=hidden.device)
        places = places if wanted is None else places[wanted]
        attended = self._attend(queries, keys, values, places, whole=past == 0 and wanted is None)
        gathered: Tensor = self.residual_dropout(self.outputs(attended.transpose(1, 2).flatten(2)))
        return gathered

    def _split(self, hidden: Tensor, wanted: slice | None) -> tuple[Tensor, Tensor, Tensor]:
        """Queries of the wanted tokens, keys and values of all, (B, heads, n, width / heads) each."""
        if wanted is None:
            split = self.inputs(hidden).unflatten(-1, (3, self.heads, -1))
            queries, keys, values = split.permute(2, 0, 3, 1, 4)
            return queries, keys, values
        weight, bias, width = self.inputs.weight, self.inputs.bias, self.width
        asking = F.linear(hidden[:, wanted], weight[:width], bias[:width]).unflatten(-1, (self.heads, -1))
        asked = F.linear(hidden, weight[width:], bias[width:]).unflatten(-1, (2, self.heads, -1))
        keys, values = asked.permute(2, 0, 3, 1, 4)
        return asking.transpose(1, 2), keys, values

    def _attend(self, queries: Tensor, keys: Tensor, values: Tensor, places: Tensor, *, whole: bool) -> Tensor:
        """Queries at places (m,) among the keys; ``whole`` where these are all, and only theirs."""
        share = self.dropout if self.training else 0.0
        if share and queries.device.type == "cpu":
            return attend_in_parts(queries, keys, values, places, share)
        mask = None if whole else _seen(places, keys.shape[2])
        return F.scaled_dot_product_attention(queries, keys, values, mask, share, is_causal=whole)


def attend_in_parts(queries: Tensor, keys: Tensor, values: Tensor, places: Tensor, share: float) -> Tensor:
    """Attention with dropout, written out: on a CPU twice as fast as torch's, whose fast kernel has no dropout.

    Args:
        queries: (B, heads, m, D). keys, values: (B, heads, n, D). places: (m,) int64, ascending: those of the queries
            among the keys. share: of the weights that are dropped.

    Returns:
        (B, heads, m, D).
    """
    batch = queries.shape[:2]
    queries = (queries / math.sqrt(queries.shape[-1])).flatten(0, 1)
    keys, values = keys.flatten(0, 1), values.flatten(0, 1)  # copied once here, else by each product of each part
    parts = []
    for asking, at in zip(queries.split(_PART, dim=1), places.split(_PART), strict=True):
        last = int(at[-1]) + 1
        hidden = torch.zeros(len(at), last).masked_fill(~_seen(at, last), -math.inf)
        weights = torch.baddbmm(hidden, asking, keys[:, :last].transpose(1, 2)).softmax(-1)
        parts.append(torch.bmm(dropped(weights, share), values[:, :last]))
    return torch.cat(parts, dim=1).unflatten(0, batch)


def _seen(places: Tensor, keys: int) -> Tensor:
    """(m, keys) bool: the token at each place sees those before it and itself."""
    return torch.arange(keys, device=places.device) <= places.unsqueeze(1)
