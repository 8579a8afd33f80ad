"""What agents with one deterministic actor and twin critics share (TD3, Fujimoto et al. 2018; DrQ-v2)."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor, nn

from repdib_lightning.rl.networks import TwinCritic


def noisy(actions: Tensor, deviation: float, clip: float) -> Tensor:
    """Add clipped normal noise; the result stays in [-1, 1], with the gradient of the actions.

    Args:
        actions: (B, A). deviation, clip: of the noise.
    """
    moved = actions + (deviation * torch.randn_like(actions)).clamp(-clip, clip)
    return moved.detach().clamp(-1.0, 1.0) + (moved - moved.detach())


def critic_loss(
    critic: TwinCritic, seen: Tensor, actions: Tensor, returns: Tensor, discounts: Tensor, later_values: Tensor
) -> tuple[Tensor, Tensor]:
    """Squared error of both critics against R_n + gamma^m V', summed over the two, and their mean value.

    Args:
        critic: trained. seen: (B, M), with a gradient where the features are trained. actions: (B, A).
        returns, discounts, later_values: (B,).
    """
    wanted = returns + discounts * later_values
    both = critic(seen, actions)
    return (both - wanted).square().mean(1).sum(), both.detach().mean()


def smaller_value(critic: TwinCritic, seen: Tensor, actions: Tensor) -> Tensor:
    """The smaller of both values, (B,), with a gradient for the actions and none for the critic's weights."""
    critic.requires_grad_(False)
    values: Tensor = critic(seen, actions).amin(0)
    critic.requires_grad_(True)
    return values


@torch.no_grad()
def follow(target: nn.Module, source: nn.Module, rate: float) -> None:
    """Move the weights of a target network towards those of its source: w' <- w' + rate (w - w')."""
    pairs = zip(target.parameters(), source.parameters(), strict=True)
    targets, sources = zip(*pairs, strict=True)
    torch._foreach_lerp_(list(targets), list(sources), rate)


def descend(loss: Tensor, *optimizers: Any) -> None:
    """One step of these optimisers down the gradient of a loss."""
    for optimizer in optimizers:
        optimizer.zero_grad(set_to_none=True)
    loss.backward()
    for optimizer in optimizers:
        optimizer.step()


def adam(parameters: Any, learning_rate: float) -> torch.optim.Optimizer:
    """Adam that updates all weights in one pass."""
    return torch.optim.Adam(list(parameters), lr=learning_rate, fused=True)
