"""The networks of offline agents: what is seen to features, an actor, and a pair of critics."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from repdib_lightning.encoders.augmentation import random_shift
from repdib_lightning.encoders.base import Encoder
from repdib_lightning.encoders.convolutional import initialise_orthogonally
from repdib_lightning.rl.fast_linear import FastLinear


class StandardisedLatents(nn.Module):
    """Latents (B, M) with mean 0 and deviation 1 in each dimension that varies (TD3+BC, Fujimoto and Gu 2021, s).

    Args:
        mean, deviation: (M,), of the training rows.
    """

    mean: Tensor
    scale: Tensor

    def __init__(self, mean: Tensor, deviation: Tensor) -> None:
        super().__init__()
        self.register_buffer("mean", mean)
        self.register_buffer("scale", torch.where(deviation > 1e-3 * deviation.max(), 1.0 / deviation, 0.0))

    def forward(self, latents: Tensor) -> Tensor:
        """(B, M) to (B, M)."""
        standardised: Tensor = (latents - self.mean) * self.scale
        return standardised


class ShiftedPictures(nn.Module):
    """An encoder that is trained by the critic, on randomly shifted pictures (DrQ-v2, Yarats et al. 2021).

    Args:
        encoder: observations to (B, M). shift: largest shift in pixels, in training mode.
    """

    def __init__(self, encoder: Encoder, shift: int) -> None:
        super().__init__()
        self.encoder, self.shift = encoder, shift

    def forward(self, observations: dict[str, Tensor]) -> Tensor:
        """Name -> (B, *shape) to (B, M)."""
        if self.training:
            observations = {name: random_shift(array, self.shift) for name, array in observations.items()}
        encoded: Tensor = self.encoder(observations)
        return encoded


def perceptron(inputs: int, hidden: int, outputs: int) -> nn.Sequential:
    """Two hidden ReLU layers; orthogonal start, as in DrQ-v2."""
    layers: list[nn.Module] = []
    for width in (inputs, hidden):
        layers += [FastLinear(width, hidden), nn.ReLU(inplace=True)]
    network = nn.Sequential(*layers, FastLinear(hidden, outputs))
    network.apply(initialise_orthogonally)
    return network


class Actor(nn.Module):
    """Features (B, M) to actions (B, A) in (-1, 1). Attributes: ``features``, M."""

    def __init__(self, features: int, actions: int, hidden: int) -> None:
        super().__init__()
        self.features = features
        self.network = perceptron(features, hidden, actions)

    def forward(self, features: Tensor) -> Tensor:
        """(B, M) to (B, A)."""
        return torch.tanh(self.network(features))


class TwinCritic(nn.Module):
    """Features (B, M) and actions (B, A) to two values, (2, B)."""

    def __init__(self, features: int, actions: int, hidden: int) -> None:
        super().__init__()
        self.first = perceptron(features + actions, hidden, 1)
        self.second = perceptron(features + actions, hidden, 1)

    def forward(self, features: Tensor, actions: Tensor) -> Tensor:
        """(B, M) and (B, A) to (2, B)."""
        joined = torch.cat([features, actions], dim=-1)
        return torch.stack([self.first(joined), self.second(joined)]).squeeze(-1)
