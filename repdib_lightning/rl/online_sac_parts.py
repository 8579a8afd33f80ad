"""Stable-Baselines3's SAC with an encoder that its critic trains, or on vectors."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import gymnasium
import torch
from stable_baselines3 import SAC
from stable_baselines3.common.policies import ContinuousCritic
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from stable_baselines3.common.utils import polyak_update
from stable_baselines3.sac.policies import MultiInputPolicy
from torch import Tensor, nn

from repdib_lightning.encoders.augmentation import random_shift
from repdib_lightning.rl.features import BottleneckFeatures
from repdib_lightning.rl.last_good import LastGood, Spoiled, check_sound
from repdib_lightning.rl.online_encoder import evaluated


class ShiftedFeatures(BottleneckFeatures):
    """As :class:`BottleneckFeatures`, on randomly shifted pictures in training mode (DrQ, Kostrikov et al. 2020).

    Args:
        observation_space, description, bottleneck_losses: see there. shift: largest shift in pixels.
    """

    def __init__(
        self,
        observation_space: gymnasium.Space[Any],
        description: Mapping[str, Any],
        bottleneck_losses: float = 1.0,
        shift: int = 0,
    ) -> None:
        super().__init__(observation_space, description, bottleneck_losses)
        self.shift = shift

    def forward(self, observations: dict[str, Tensor]) -> Tensor:
        """Encode name -> (N, *shape) into (N, M)."""
        if self.training:
            observations = {name: random_shift(array, self.shift) for name, array in observations.items()}
        return super().forward(observations)


class SeenByCritic(BaseFeaturesExtractor):
    """Features of another network's encoder, in evaluation mode and without a gradient; owns no weights.

    Args:
        features: of the critic.
    """

    def __init__(self, features: BottleneckFeatures) -> None:
        super().__init__(features._observation_space, features.features_dim)
        self._features = (features,)  # a tuple, so that the weights stay the critic's alone

    def forward(self, observations: dict[str, Tensor]) -> Tensor:
        """Name -> (N, *shape) to (N, M)."""
        (features,) = self._features
        return evaluated(features.encoder, features.bottleneck, observations)


class EncoderCritic(ContinuousCritic):
    """Trains its encoder by its own loss; where it tells the actor the value of its actions, the encoder stays."""

    def forward(self, obs: Any, actions: Tensor) -> tuple[Tensor, ...]:
        """Values (N, 1) of each critic."""
        features: Any = self.features_extractor
        assert isinstance(features, BottleneckFeatures)
        seen = self.extract_features(obs, SeenByCritic(features) if actions.requires_grad else features)
        return tuple(network(torch.cat([seen, actions], dim=1)) for network in self.q_networks)


class EncoderPolicy(MultiInputPolicy):
    """One encoder for actor and critic, trained by the critic, as in DrQ.

    Stable-Baselines3's own policies train an encoder for each, or one by the actor's loss.
    """

    def make_critic(self, features_extractor: BaseFeaturesExtractor | None = None) -> ContinuousCritic:
        """A critic with an encoder."""
        arguments = self._update_features_extractor(self.critic_kwargs, features_extractor)
        return EncoderCritic(**arguments).to(self.device)

    def _build(self, lr_schedule: Any) -> None:
        super()._build(lr_schedule)
        features: Any = self.critic.features_extractor
        self.actor.features_extractor = SeenByCritic(features)
        self.actor.optimizer = self.optimizer_class(
            self.actor.parameters(),
            lr=lr_schedule(1),  # type: ignore[call-arg]
            **self.optimizer_kwargs,
        )


class BottleneckSAC(SAC):
    """SAC whose target critic follows in its running codebooks too, and which stops where its critic diverges.

    Attributes:
        value_limit: mean values beyond it are not sound. latest: name -> value of the last update.
        last_good: of actor and encoder.
    """

    value_limit: float = float("inf")

    def _setup_model(self) -> None:
        super()._setup_model()
        self._followed = _running(self.critic), _running(self.critic_target)
        modules = [self.actor, self.critic.features_extractor]
        self.last_good = LastGood([module for module in modules if list(module.parameters())])
        self.latest: dict[str, float] = {}
        self.critic.register_forward_hook(self._note)

    def _note(self, module: nn.Module, given: Any, values: tuple[Tensor, ...]) -> None:
        self._value = torch.cat(values).detach().mean()

    def train(self, gradient_steps: int, batch_size: int = 64) -> None:
        """Update as often as asked.

        Raises:
            Spoiled: a loss or a value is not sound; the weights before this update are to be distrusted, too.
        """
        self.last_good.offer()
        try:
            super().train(gradient_steps, batch_size)
        except ValueError as error:  # a normal distribution refuses a mean that is no number
            raise Spoiled("train/actor is nan") from error
        polyak_update(*self._followed, self.tau)
        logged: dict[str, Any] = self.logger.name_to_value
        found = {"critic": logged["train/critic_loss"], "value": self._value, "actor": logged["train/actor_loss"]}
        found["temperature"] = logged["train/ent_coef"]
        self.latest = {name: float(value) for name, value in found.items()}
        check_sound(self.latest, self.value_limit)
        self.last_good.accept()

    def _excluded_save_params(self) -> list[str]:
        ours = "_followed", "last_good", "latest", "_value"
        return [*super()._excluded_save_params(), *ours, "replay_buffer_class"]  # which a loaded agent would warn of


def _running(network: nn.Module) -> list[Tensor]:
    """Buffers with fractions; counters stay as they are."""
    return [buffer for buffer in network.buffers() if buffer.is_floating_point()]
