"""Reward-free exploration: a representation, and an agent that is rewarded for what it has not seen."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import Any, Literal

import numpy as np
import torch
from lightning.pytorch.cli import OptimizerCallable
from torch import Tensor

from repdib_lightning.bottlenecks import Bottleneck
from repdib_lightning.encoders.augmentation import random_shift
from repdib_lightning.encoders.base import Encoder
from repdib_lightning.errors import UserError, nearest
from repdib_lightning.objectives.base import Objective
from repdib_lightning.objectives.prototypes import Prototypes
from repdib_lightning.records import Batch, BottleneckOutput, DataSpec
from repdib_lightning.representation import RepresentationModule, named_values
from repdib_lightning.rl.actor_critic import descend
from repdib_lightning.rl.exploration.ddpg import DDPG
from repdib_lightning.rl.exploration.intrinsic_reward import NearestNeighbourReward
from repdib_lightning.rl.exploration.replay import ReplayBatch

RewardOn = Literal["latent", "features", "codes"]
REWARDS_ON = ("latent", "features", "codes")
_AT_BOUNDS = 0.99
"""Size of an action from which on its actor has next to no gradient."""


class BrokenExploration(UserError):
    """The losses of the agent are no longer of use; what there was before is untouched."""


class ExplorationModule(RepresentationModule):
    """ProtoRL on DDPG (Yarats et al. 2021; URLB, Laskin et al. 2021), with a bottleneck (paper, continuous control).

    One step: the representation takes a step on its objective; then the reward of each transition is how far what
    it leads to is from the nearest in a queue of what was seen; the critic and the actor take a step on latents that
    get no gradient. Only in between does the data module step the environments.

    The reward of a transition over n steps is that of its last observation alone, as published.

    Args:
        encoder, bottleneck, objective, optimizer, loss_weights, warmup, shift: see
            :class:`~repdib_lightning.representation.RepresentationModule`. Any objective explores; with
            :class:`~repdib_lightning.objectives.prototypes.Prototypes` distances are those of its embedding, and one
            observation enters the queue for each prototype, else those of normalised latents, and all enter it.
        hidden: width of the two hidden layers of actor and critics.
        agent_learning_rate: Adam's, of actor and critics. tau: rate of the target critic.
        noise: deviation of the exploring noise, and of that in the losses, which is clipped at ``noise_clip``.
        standardise: whether actor and critics see latents less their mean, over their deviation.
        action_penalty: weight of the squared actions in the actor's loss.
        reward_on: what is compared: the ``latent`` behind the bottleneck (paper: the discrete factorial embedding), the
            encoder's ``features`` before it, or its ``codes``, by the share of groups that differ.
        queue: what was seen that is remembered. neighbours: k, distance to the k-th nearest.
        duplicates: what becomes of equal ones: see
            :class:`~repdib_lightning.rl.exploration.intrinsic_reward.NearestNeighbourReward`.
        value_limit: the run is stopped where the mean value is larger in size; no return can be.

    Raises:
        UserError: a number out of range, an unknown choice, or codes of a bottleneck that has none.
    """

    agent: DDPG
    reward: NearestNeighbourReward

    def __init__(
        self,
        encoder: Callable[[DataSpec], Encoder],
        bottleneck: Callable[[int], Bottleneck],
        objective: Callable[[int, DataSpec], Objective],
        optimizer: OptimizerCallable = torch.optim.Adam,
        loss_weights: dict[str, float] | None = None,
        warmup: dict[str, int] | None = None,
        shift: int = 4,
        hidden: int = 1024,
        agent_learning_rate: float = 1e-4,
        tau: float = 0.01,
        noise: float = 0.2,
        noise_clip: float = 0.3,
        standardise: bool = False,
        action_penalty: float = 0.0,
        reward_on: RewardOn = "latent",
        queue: int = 2048,
        neighbours: int = 3,
        duplicates: Literal["keep", "distinct", "count"] = "count",
        value_limit: float = 1e4,
    ) -> None:
        super().__init__(encoder, bottleneck, objective, optimizer, None, loss_weights, warmup, shift)
        self.automatic_optimization = False
        self.hidden, self.agent_learning_rate = hidden, agent_learning_rate
        self.tau, self.noise, self.noise_clip, self.standardise = tau, noise, noise_clip, standardise
        self.action_penalty = action_penalty
        self.reward_on, self.queue, self.neighbours, self.duplicates = reward_on, queue, neighbours, duplicates
        self.value_limit = value_limit
        if reward_on not in REWARDS_ON:
            raise UserError(f"model.reward_on is {reward_on}: unknown, {nearest(reward_on, REWARDS_ON)}")
        for name in ("hidden", "agent_learning_rate", "tau", "value_limit"):
            if not getattr(self, name) > 0:
                raise UserError(f"model.{name} must be above 0, is {getattr(self, name)}")
        if self.tau > 1:
            raise UserError(f"model.tau must be at most 1, is {self.tau}")
        for name in ("noise", "noise_clip", "action_penalty"):
            if not getattr(self, name) >= 0:
                raise UserError(f"model.{name} must not be negative, is {getattr(self, name)}")

    def build(self, spec: DataSpec) -> ExplorationModule:
        """Build all parts for data of this spec."""
        super().build(spec)
        assert spec.actions is not None
        groups = getattr(self.bottleneck, "groups", 0)
        if self.reward_on == "codes" and not groups:
            raise UserError("model.reward_on is codes: this bottleneck has none; choose latent or features")
        self.agent = DDPG(
            self.encoder.features,
            spec.actions.size,
            hidden=self.hidden,
            tau=self.tau,
            noise=self.noise,
            noise_clip=self.noise_clip,
            standardise=self.standardise,
            penalty=self.action_penalty,
        )
        on_codes = self.reward_on == "codes"
        self.reward = NearestNeighbourReward(
            groups if on_codes else self._embedded,
            queue=self.queue,
            neighbours=self.neighbours,
            duplicates=self.duplicates,
            distance="hamming" if on_codes else "euclidean",
            groups=groups if self.reward_on == "latent" else 0,
        )
        return self

    @property
    def _embedded(self) -> int:
        """Width of what distances are measured between."""
        objective = self.objective
        return objective.projected if isinstance(objective, Prototypes) else self.encoder.features

    def configure_optimizers(self) -> Any:
        """One for the representation, one for the critics, one for the actor."""
        of_agent = {id(parameter) for parameter in self.agent.parameters()}
        trained = [p for p in self.parameters() if id(p) not in of_agent and p.requires_grad]
        return [self.build_optimizer(trained), *self.agent.build_optimizers(self.agent_learning_rate)]

    def act(self, observations: dict[str, np.ndarray], noise: np.ndarray | None = None) -> np.ndarray:
        """What the agent does.

        Args:
            observations: name -> (E, *shape). noise: (E, A) standard normal, to explore; None for none.

        Returns:
            (E, A) float32 in [-1, 1].
        """
        seen = {name: torch.from_numpy(array).to(self.device) for name, array in observations.items()}
        with self._still():
            latents = self(seen).latent
            drawn = None if noise is None else torch.from_numpy(noise).to(self.device)
            actions: np.ndarray = self.agent.act(latents, drawn).float().cpu().numpy()
        return actions

    @contextmanager
    def _still(self) -> Iterator[None]:
        """Encode without gradient and noise, and without a trace in codebooks and statistics."""
        modules = [module for part in (self.encoder, self.bottleneck) for module in part.modules() if module.training]
        for module in modules:
            module.training = False
        try:
            with torch.no_grad():
                yield
        finally:
            for module in modules:
                module.training = True

    def training_step(self, batch: Batch, batch_index: int) -> dict[str, Any]:
        """One update of the representation, one of the critics, one of the actor.

        Raises:
            BrokenExploration: the critics' loss is not finite, or their values have exploded; they stay as they were.
        """
        assert isinstance(batch, ReplayBatch)
        optimizers: Any = self.optimizers()
        of_representation, of_critic, of_actor = optimizers
        written = self._writes_this_step()  # told by the count that the optimiser's step will change
        shifted = {name: self._shifted(pairs) for name, pairs in batch.observations.items()}
        batch = replace(batch, observations=shifted)
        output = self._evaluate(batch)
        terms = {name: value * self._weight(name) for name, value in output.losses.items()}
        loss = torch.stack(list(terms.values())).sum()
        descend(loss, of_representation)  # the only step that Lightning counts
        self.follow_target()
        seen, later, rewards, told = self._rewarded(batch, duplicates=written)
        assert batch.actions is not None
        of_values, value = self.agent.critic_loss(seen, later, batch.actions, rewards, batch.discounts)
        self._check_values(of_values, value)
        descend(of_values, of_critic.optimizer)
        of_policy = self.agent.update_actor(seen, of_actor.optimizer)
        told |= {"critic_loss": of_values.detach(), "value": value, "actor_loss": of_policy}
        if written:
            told["at_bounds"] = (self.agent.act(seen).abs() > _AT_BOUNDS).float().mean()
            self._log(named_values("train", loss, output, terms) | {f"explore/{name}": v for name, v in told.items()})
        return {"loss": loss.detach(), "terms": {name: value.detach() for name, value in output.losses.items()}}

    def _rewarded(
        self, batch: ReplayBatch, duplicates: bool = True
    ) -> tuple[Tensor, Tensor, Tensor, dict[str, Tensor]]:
        """Latents (B, M) of both observations, rewards (B,), and what is told of them."""
        pairs = {name: array.flatten(0, 1) for name, array in batch.observations.items()}
        with self._still():
            output: BottleneckOutput = self(pairs)
        seen, later = output.latent.unflatten(0, (-1, 2)).unbind(1)
        compared, codes = self._compared(pairs, output), None
        if self.reward_on == "latent" and output.codes is not None:
            codes = output.codes[1::2]
        told = {"duplicates": self.reward.duplicated(compared, codes)} if duplicates else {}
        rewards = self.reward(compared, self._entering(compared, later), codes)
        told["intrinsic_reward"] = rewards.mean()
        return seen.contiguous(), later.contiguous(), rewards, told

    def _shifted(self, pairs: Tensor) -> Tensor:
        """Shift (B, 2, C, H, W): all that is computed in a step sees the same pictures, as published."""
        if pairs.dtype != torch.uint8:
            return pairs
        return random_shift(pairs.flatten(0, 1), self.shift).unflatten(0, pairs.shape[:2])

    def _augment(self, observation: Tensor) -> Tensor:
        """They are shifted already."""
        return observation

    @torch.no_grad()
    def _compared(self, pairs: dict[str, Tensor], output: BottleneckOutput) -> Tensor:
        """(B, P): what distances are measured between, of the later observations."""
        if self.reward_on == "codes":
            if output.codes is None:  # the quantiser has not started
                return torch.zeros(len(output.latent) // 2, self.reward.width, device=self.device)
            return output.codes[1::2].float()
        if self.reward_on == "features":
            with self._still():
                return self._embed(self.encoder.detailed({name: array[1::2] for name, array in pairs.items()}).features)
        return self._embed(output.latent[1::2])

    def _embed(self, latents: Tensor) -> Tensor:
        if isinstance(self.objective, Prototypes):
            return self.objective.embed(latents)
        return torch.nn.functional.normalize(latents, dim=-1)

    def _entering(self, compared: Tensor, later: Tensor) -> Tensor:
        """Which of the batch enter the queue, (n,)."""
        if isinstance(self.objective, Prototypes):
            embedded = compared if self.reward_on != "codes" else self.objective.embed(later)
            return self.objective.candidates(embedded)
        return torch.arange(len(compared), device=compared.device)

    def _check_values(self, loss: Tensor, value: Tensor) -> None:
        """Stop before a step that would break the critics."""
        found = torch.stack([loss.detach(), value])
        size = float(value.abs())
        if not bool(found.isfinite().all()):
            raise BrokenExploration(f"step {self.global_step}: the critics' loss is not finite ({found.tolist()})")
        if size > self.value_limit:
            raise BrokenExploration(
                f"step {self.global_step}: the critics' mean value is {size:.4g}, above model.value_limit "
                f"{self.value_limit:g}; a lower model.agent_learning_rate may help"
            )
