"""DDPG on features: what explores, and what is fine-tuned (DrQ-v2, Yarats et al. 2021; URLB, Laskin et al. 2021)."""

from __future__ import annotations

import copy
from collections.abc import Iterable

import torch
from torch import Tensor, nn

from repdib_lightning.rl.actor_critic import adam, critic_loss, descend, follow, noisy, smaller_value
from repdib_lightning.rl.exploration.running_statistics import RunningStatistics
from repdib_lightning.rl.networks import Actor, TwinCritic


class DDPG(nn.Module):
    """An actor and twin critics on features (paper, table of continuous control; the losses are DrQ-v2's).

    - critic: (Q_i(s, a) - R_n - gamma^m min_j Q'_j(s', clip(pi(s') + e)))^2, summed over i;
    - actor: - mean min_j Q_j(s, clip(pi(s) + e)) + penalty mean pi(s)^2, on detached features;
    - e: normal with ``noise``, clipped at ``noise_clip``; the target critic follows at the rate tau.

    With ``standardise``, actor and critics see each feature less its running mean over its running deviation: frames of
    one environment are alike, and what differs between their latents is small beside what they share. The averages are
    taken over what the critic is trained on, and saved with the agent.

    Args:
        features: M. actions: A. hidden: width of the two hidden layers.
        tau: rate of the target critic. noise, noise_clip: of the actions; exploring actions are not clipped but to
            [-1, 1].
        standardise: see above; not in the published programs.
        penalty: on large actions (as in Plappert et al. 2018, "Multi-Goal Reinforcement Learning"; 0 in the published
            programs of URLB): an actor that is at the bounds has no gradient to come back by.
    """

    def __init__(
        self,
        features: int,
        actions: int,
        *,
        hidden: int = 1024,
        tau: float = 0.01,
        noise: float = 0.2,
        noise_clip: float = 0.3,
        standardise: bool = False,
        penalty: float = 0.0,
    ) -> None:
        super().__init__()
        self.statistics = RunningStatistics(features) if standardise else None
        self.actor, self.critic = Actor(features, actions, hidden), TwinCritic(features, actions, hidden)
        self.target = copy.deepcopy(self.critic).requires_grad_(False)
        self.tau, self.noise, self.noise_clip, self.penalty = tau, noise, noise_clip, penalty

    @torch.no_grad()
    def act(self, features: Tensor, noise: Tensor | None = None) -> Tensor:
        """(B, M) to actions (B, A); with standard normal noise (B, A), scaled, where it explores."""
        actions: Tensor = self.actor(self.seen(features))
        return actions if noise is None else (actions + self.noise * noise).clamp(-1.0, 1.0)

    @torch.no_grad()
    def values(self, features: Tensor) -> Tensor:
        """(B, M) to (B,): the smaller value of the actor's own action."""
        return self.values_of(features, self.act(features))

    @torch.no_grad()
    def values_of(self, features: Tensor, actions: Tensor) -> Tensor:
        """(B, M) and (B, A) to (B,): the smaller value of these actions."""
        values: Tensor = self.critic(self.seen(features), actions).amin(0)
        return values

    def seen(self, features: Tensor) -> Tensor:
        """What actor and critics see of features (B, M)."""
        return features if self.statistics is None else self.statistics(features)

    def critic_loss(
        self, seen: Tensor, later: Tensor, actions: Tensor, returns: Tensor, discounts: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Scalar loss, and the mean value of the replayed actions.

        Args:
            seen, later: features (B, M) of t and of t + m; ``seen`` may carry a gradient.
            actions: (B, A), at t. returns, discounts: (B,).
        """
        if self.statistics is not None:
            self.statistics.take_in(seen.detach())
        seen, later = self.seen(seen), self.seen(later)
        with torch.no_grad():
            values = self.target(later, noisy(self.actor(later), self.noise, self.noise_clip)).amin(0)
        return critic_loss(self.critic, seen, actions, returns, discounts, values)

    def actor_loss(self, seen: Tensor) -> Tensor:
        """Scalar loss on features (B, M), which get no gradient."""
        seen = self.seen(seen.detach())
        actions = self.actor(seen)
        values = smaller_value(self.critic, seen, noisy(actions, self.noise, self.noise_clip))
        return self.penalty * actions.square().mean() - values.mean()

    def follow(self) -> None:
        """Move the target critic by tau."""
        follow(self.target, self.critic, self.tau)

    def build_optimizers(
        self, learning_rate: float, features: Iterable[nn.Parameter] = ()
    ) -> tuple[torch.optim.Optimizer, torch.optim.Optimizer]:
        """One Adam for the critic, and for weights of the features that it trains; one for the actor."""
        return adam([*features, *self.critic.parameters()], learning_rate), adam(self.actor.parameters(), learning_rate)

    def update_actor(self, seen: Tensor, optimizer: torch.optim.Optimizer) -> Tensor:
        """One step of the actor and one of the target; returns the actor's loss."""
        loss = self.actor_loss(seen)
        descend(loss, optimizer)
        self.follow()
        return loss.detach()
