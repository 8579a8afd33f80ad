"""Stable-Baselines3's SAC that plays a task: on latents, each frame encoded once, or on pictures with its encoder."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import torch
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import Logger
from torch import Tensor

from repdib_lightning.errors import UserError
from repdib_lightning.export.description import bundle_config
from repdib_lightning.export.gymnasium_wrapper import EncodeObservation, PrepareObservation
from repdib_lightning.rl.features import BottleneckFeatures
from repdib_lightning.rl.last_good import Spoiled
from repdib_lightning.rl.online_options import HIDDEN, SACOptions
from repdib_lightning.rl.online_progress import OnlineProgress
from repdib_lightning.rl.online_sac_parts import BottleneckSAC, EncoderPolicy, ShiftedFeatures
from repdib_lightning.rl.online_training import OnlineTraining
from repdib_lightning.rl.progress import POLICY


class SACTraining(OnlineTraining):
    """Builds a fresh agent; the seed frames are played at random.

    Raises:
        UserError: as :class:`OnlineTraining`; pictures that Stable-Baselines3 would turn, or a replay that does not fit
            into memory.
    """

    POLICY = POLICY
    options: SACOptions

    def _build(self) -> None:
        options = self.options
        self.hidden = options.hidden or HIDDEN
        network: dict[str, Any] = {"net_arch": [self.hidden, self.hidden], "optimizer_kwargs": {"fused": True}}
        try:
            self.agent = BottleneckSAC(
                "MlpPolicy" if self.parts is None else EncoderPolicy,
                self._as_seen(),
                learning_rate=options.learning_rate,
                batch_size=options.batch_size,
                gamma=options.gamma,
                tau=options.tau,
                buffer_size=min(options.buffer_size, self.schedule.total),
                learning_starts=self.schedule.seed,
                train_freq=options.update_every,
                gradient_steps=1,
                n_steps=options.steps_of_returns,
                policy_kwargs=network | self._features_of_network(),
                seed=options.seed,
                device=self.device,
            )
        except MemoryError as error:
            raise UserError(f"--buffer_size {options.buffer_size}: does not fit into memory ({error})") from error
        self.agent.value_limit = options.value_limit
        self.agent.set_logger(Logger(None, []))  # its own would write a second file for TensorBoard
        if self.parts is not None:
            self._take_parts()

    def _as_seen(self) -> gymnasium.Env[Any, Any]:
        if self.frozen is not None:
            return EncodeObservation(self.environment, self.frozen)
        for name, array in self.spec.observations.items():
            # Stable-Baselines3 takes the smallest side for the channels, and would turn the picture.
            if array.is_image and array.shape[0] > min(array.shape[1:]):
                shown = f"'{name}' {array.shape} has more channels than pixels along a side"
                raise UserError(f"--frozen false: {shown}; --frozen true takes it")
        return PrepareObservation(self.environment, self.spec)

    def _features_of_network(self) -> dict[str, Any]:
        if self.parts is None:
            return {}
        options = {"bottleneck_losses": self.options.losses_weight, "shift": self.options.pixels}
        description = bundle_config(*self.parts, {}, {})
        return {
            "features_extractor_class": ShiftedFeatures,
            "features_extractor_kwargs": {"description": description, **options},
            "normalize_images": False,
        }

    def _take_parts(self) -> None:
        """Load encoder and bottleneck into the critic, which trains them from here on."""
        assert self.parts is not None
        features = self.agent.critic.features_extractor
        assert isinstance(features, BottleneckFeatures)
        features.encoder.load_state_dict(self.parts[0].state_dict())
        features.bottleneck.load_state_dict(self.parts[1].state_dict())
        self.agent.critic_target.load_state_dict(self.agent.critic.state_dict())
        self.agent.last_good.offer()
        self.agent.last_good.accept()
        self.parts = features.encoder, features.bottleneck

    def mean_actions(self, features: Tensor) -> Tensor:
        """(n, M) to (n, A)."""
        actor: Any = self.agent.actor
        return torch.tanh(actor.mu(actor.latent_pi(features)))

    def values(self, features: Tensor, actions: Tensor) -> Tensor:
        """(n, M) and (n, A) to (n,)."""
        joined = torch.cat([features, actions], dim=1)
        return torch.cat([network(joined) for network in self.agent.critic.q_networks], dim=1).amin(1)

    def learn(self, folder: Path, progress: OnlineProgress) -> None:
        """Play and learn."""
        try:
            self.agent.learn(self.schedule.total, callback=_Watch(self, progress), log_interval=None)  # type: ignore[arg-type]
        except ValueError as error:
            if "Expected parameter" not in str(error):
                raise
            raise Spoiled("train/actor is nan") from error  # refused by a normal distribution, which draws the action

    def restore(self) -> None:
        """Go back to the last good actor and encoder."""
        self.agent.last_good.restore()

    def save(self, folder: Path, encoder: Path | None) -> None:
        """Write ``policy.zip``."""
        self.agent.save(folder / POLICY)


class _Watch(BaseCallback):
    """Asks for evaluations."""

    def __init__(self, training: SACTraining, progress: OnlineProgress) -> None:
        super().__init__()
        self._of, self.progress = training, progress
        self._returns: list[float] = []

    def _on_training_start(self) -> None:
        self.progress.add(0)

    def _on_step(self) -> bool:
        training = self._of
        training.played = self.num_timesteps * training.action_repeat
        if not np.isfinite(self.locals["actions"]).all():
            raise Spoiled("an action is no number")
        self._returns += [info["episode"]["r"] for info in self.locals["infos"] if "episode" in info]
        if self.progress.is_due(training.played):
            self._add()
        return True

    def _on_training_end(self) -> None:
        self._add()

    def _add(self) -> None:
        returns, self._returns = self._returns, []
        agent = self._of.agent
        found = ({"return": float(np.mean(returns))} if returns else {}) | agent.latest
        features: Any = agent.critic.features_extractor
        told = features.latest if isinstance(features, BottleneckFeatures) else {}
        self.progress.add(self._of.played, found | {name: float(value) for name, value in told.items()})
