"""Offline agents as LightningModules: TD3+BC in the form of V-D4RL, and behaviour cloning."""

from __future__ import annotations

import copy
from typing import Any

import lightning.pytorch as pl
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from repdib_lightning.rl.actor_critic import adam, critic_loss, descend, follow, noisy, smaller_value
from repdib_lightning.rl.networks import Actor, TwinCritic
from repdib_lightning.rl.transitions import Seen, TransitionBatch


class BehaviourCloning(pl.LightningModule):
    """The actor repeats the actions of the data: mean squared error over all dimensions.

    Args:
        features: what is seen to (B, M): :class:`~repdib_lightning.rl.networks.StandardisedLatents`, or an encoder that
            is trained too.
        width: M. actions: A. hidden: width of the two hidden layers. learning_rate: Adam's.
    """

    def __init__(self, features: nn.Module, width: int, actions: int, *, hidden: int, learning_rate: float) -> None:
        super().__init__()
        self.automatic_optimization = False
        self.features, self.actor = features, Actor(width, actions, hidden)
        self.learning_rate = learning_rate
        self.latest: dict[str, Tensor] = {}

    def act(self, seen: Seen) -> Tensor:
        """Actions (B, A) of the mean policy."""
        acted: Tensor = self.actor(self.features(seen))
        return acted

    def configure_optimizers(self) -> Any:
        """Adam over actor and features."""
        return adam([*self.features.parameters(), *self.actor.parameters()], self.learning_rate)

    def training_step(self, batch: TransitionBatch, number: int) -> None:
        """One update."""
        loss = F.mse_loss(self.act(batch.seen), batch.actions)
        descend(loss, self.optimizers(use_pl_optimizer=False))
        self.latest = {"clone": loss.detach()}


class TD3BC(BehaviourCloning):
    """Twin critics and an actor that maximises them close to the data (TD3+BC, Fujimoto and Gu 2021), as V-D4RL has it
    on DrQ-v2: n-step returns, no delay between critic and actor, noisy actions in both.

    - critic: (Q_i(s, a) - R_n - gamma^m min_j Q'_j(s', clip(pi(s') + e)))^2, summed over i; trains the features too;
    - actor: - lambda mean Q + mean (pi(s) + e - a)^2, with lambda = alpha / mean |Q| (equation 5 there) and Q the
      smaller of both; on detached features;
    - e: normal with ``noise``, clipped at ``noise_clip``; the target critic follows at the rate tau.

    V-D4RL lets the noise fall from 1.0 to 0.1; clipped at 0.3 it is much the same early on. Here it is constant.

    Args:
        features, width, actions, hidden, learning_rate: as :class:`BehaviourCloning`.
        alpha: weight of the values against the cloning.
        tau: rate of the target critic.
        noise, noise_clip: of the actions.
    """

    def __init__(
        self,
        features: nn.Module,
        width: int,
        actions: int,
        *,
        hidden: int,
        learning_rate: float,
        alpha: float = 2.5,
        tau: float = 0.01,
        noise: float = 0.2,
        noise_clip: float = 0.3,
    ) -> None:
        super().__init__(features, width, actions, hidden=hidden, learning_rate=learning_rate)
        self.critic = TwinCritic(width, actions, hidden)
        self.target = copy.deepcopy(self.critic).requires_grad_(False)
        self.alpha, self.tau, self.noise, self.noise_clip = alpha, tau, noise, noise_clip

    def configure_optimizers(self) -> Any:
        """One Adam for critic and features, one for the actor."""
        critic = adam([*self.features.parameters(), *self.critic.parameters()], self.learning_rate)
        return [critic, adam(self.actor.parameters(), self.learning_rate)]

    def training_step(self, batch: TransitionBatch, number: int) -> None:
        """One update of the critic, one of the actor, one of the target."""
        optimizers: Any = self.optimizers(use_pl_optimizer=False)
        of_critic, of_actor = optimizers
        seen = self.features(batch.seen)
        loss, value = self.critic_loss(seen, batch)
        descend(loss, of_critic)
        seen = seen.detach()
        of_values, cloning = self.actor_losses(seen, batch.actions)
        descend(of_values + cloning, of_actor)
        self.follow()
        self.latest = {"critic": loss.detach(), "clone": cloning.detach(), "value": value}

    def critic_loss(self, seen: Tensor, batch: TransitionBatch) -> tuple[Tensor, Tensor]:
        """Scalar loss from features (B, M), and the mean value of the data's actions."""
        with torch.no_grad():
            later = self.features(batch.later)
            values = self.target(later, self.noisy(self.actor(later))).amin(0)
        return critic_loss(self.critic, seen, batch.actions, batch.returns, batch.discounts, values)

    def actor_losses(self, seen: Tensor, actions: Tensor) -> tuple[Tensor, Tensor]:
        """What the critics and what the data ask of the actor, on features (B, M): two scalars."""
        acted = self.noisy(self.actor(seen))
        values = smaller_value(self.critic, seen, acted)
        weight = self.alpha / values.detach().abs().mean().clamp_min(1e-6)
        return -weight * values.mean(), F.mse_loss(acted, actions)

    def noisy(self, actions: Tensor) -> Tensor:
        """Add clipped noise; the result stays in [-1, 1], with the gradient of the actions."""
        return noisy(actions, self.noise, self.noise_clip)

    def follow(self) -> None:
        """Move the target critic by tau."""
        follow(self.target, self.critic, self.tau)
