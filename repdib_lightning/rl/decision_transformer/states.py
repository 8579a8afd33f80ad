"""What is seen of a step to the embedding of its token."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from repdib_lightning.rl.decision_transformer.network import initialise
from repdib_lightning.rl.networks import StandardisedLatents


class LatentStates(nn.Module):
    """Latents of a frozen encoder through a linear layer and tanh, where the published encoder ends.

    Args:
        mean, deviation: (M,), of the training rows, which standardise them. width: of the transformer.
    """

    def __init__(self, mean: Tensor, deviation: Tensor, width: int) -> None:
        super().__init__()
        self.standardise = StandardisedLatents(mean, deviation)
        self.linear = nn.Linear(len(mean), width)
        self.apply(initialise)

    def forward(self, latents: Tensor) -> Tensor:
        """(B, T, M) to (B, T, width)."""
        return torch.tanh(self.linear(self.standardise(latents)))


class CodeStates(nn.Module):
    """Codes of a frozen encoder: an embedding for each code of each group, summed over the groups, and tanh.

    Args:
        groups: G. codes: L. width: of the transformer.
    """

    offsets: Tensor

    def __init__(self, groups: int, codes: int, width: int) -> None:
        super().__init__()
        self.codes = nn.Embedding(groups * codes, width)
        self.register_buffer("offsets", codes * torch.arange(groups), persistent=False)
        self.apply(initialise)

    def forward(self, codes: Tensor) -> Tensor:
        """(B, T, G) int64 to (B, T, width)."""
        return torch.tanh(self.codes(codes + self.offsets).sum(-2))


class EncodedStates(nn.Identity):
    """Features of an encoder that is trained, (B, T, width), which are embeddings already."""
