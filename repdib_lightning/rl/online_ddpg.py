"""DDPG that plays a task: on latents, each frame encoded once, or on pictures, with an encoder that its critic trains.

The agent and the replay are those of exploration; the reward is the task's.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import gymnasium
import numpy as np
import torch
from safetensors.torch import save_file
from torch import Tensor

from repdib_lightning.data.files import whole_file
from repdib_lightning.environments.urlb_tasks import domain_of
from repdib_lightning.errors import UserError
from repdib_lightning.export.gymnasium_wrapper import EncodeObservation
from repdib_lightning.records import ArraySpec
from repdib_lightning.rl.actor_critic import descend
from repdib_lightning.rl.exploration.collection import Collection
from repdib_lightning.rl.exploration.ddpg import DDPG
from repdib_lightning.rl.exploration.replay import Replay, ReplayBatch, ReplayPlan
from repdib_lightning.rl.last_good import LastGood, Spoiled, check_sound
from repdib_lightning.rl.online_encoder import TrainedFeatures
from repdib_lightning.rl.online_options import ACTOR, BOTH, HIDDEN, NEW, DDPGOptions
from repdib_lightning.rl.online_progress import OnlineProgress
from repdib_lightning.rl.online_training import OnlineTraining
from repdib_lightning.rl.policy_file import POLICY

LATENTS = "latents"
"""Name of the observation of a replay that holds no pictures."""


class DDPGTraining(OnlineTraining):
    """Builds the agent: a fresh one, or one with the actor of a snapshot, or with its actor and critic.

    The published fine-tuning starts from the actor that explored and a fresh critic, and plays its seed frames at
    random (URLB, Laskin et al. 2021). Here a loaded actor plays them, with its noise, so that what it found is there to
    learn from; a fresh one plays them at random.

    Raises:
        UserError: as :class:`OnlineTraining`; an actor of other actions or sizes; too few seed frames for a batch.
    """

    POLICY = POLICY
    options: DDPGOptions

    def _build(self) -> None:
        options = self.options
        loaded = self._start() != NEW
        self.hidden = self._hidden() if loaded else options.hidden or HIDDEN
        self.agent = DDPG(
            self.width,
            self.actions,
            hidden=self.hidden,
            tau=options.tau,
            noise=options.noise,
            noise_clip=options.noise_clip,
            standardise=self._standardise(),
            penalty=options.action_penalty,
        )
        if loaded:
            self._load()
        self.agent.to(self.device)
        self._check_batch()
        self.trained: TrainedFeatures | None = None
        if self.parts is not None:
            self.trained = TrainedFeatures(*self.parts, options.pixels, options.losses_weight)
        seen_with = [] if self.trained is None else list(self.trained.parameters())
        self.of_critic, self.of_actor = self.agent.build_optimizers(options.learning_rate, seen_with)
        followed = [self.agent.actor, self.agent.statistics, self.trained]
        self.last_good = LastGood([module for module in followed if module is not None])
        self.latest: dict[str, Tensor] = {}

    def _start(self) -> str:
        """What the agent begins with; unless said, the actor of a snapshot that has one."""
        told, there = self.options.agent, self.given.agent is not None
        if told in (ACTOR, BOTH) and not there:
            raise UserError(
                f"--agent {told}: {self.given.bundle} holds an encoder alone; name a run of exploration, or a snapshot "
                "of one, with --encoder, or take --agent fresh"
            )
        return told or (ACTOR if there and self.options.bottleneck else NEW)

    def resolved(self) -> dict[str, Any]:
        """And what the agent began with."""
        return super().resolved() | {"agent": self._start(), "standardise": self._standardise()}

    def _hidden(self) -> int:
        assert self.given.agent is not None
        hidden, chosen = int(self.given.facts["hidden"]), self.options.hidden
        if chosen not in (None, hidden):
            raise UserError(f"--hidden {chosen}: the agent of {self.given.bundle} has {hidden}; leave it out")
        return hidden

    def _standardise(self) -> bool:
        chosen = self.options.standardise
        if self._start() == NEW:
            return True if chosen is None else chosen
        explored = bool(self.given.facts.get("standardise", False))
        if chosen not in (None, explored):
            told = f"was {'' if explored else 'not '}trained on standardised features"
            raise UserError(
                f"--standardise {str(chosen).lower()}: the agent of {self.given.bundle} {told}; leave it out"
            )
        return explored

    def _load(self) -> None:
        assert self.given.agent is not None
        self._check_domain()
        try:
            self.agent.actor.load_state_dict(self.given.agent.part("actor."))
            if self.agent.statistics is not None:
                self.agent.statistics.load_state_dict(self.given.agent.part("statistics."))
            if self._start() == BOTH:
                self.agent.critic.load_state_dict(self.given.agent.part("critic."))
                self.agent.target.load_state_dict(self.given.agent.part("target."))
        except RuntimeError as error:
            reason = str(error).splitlines()[-1].strip()
            raise UserError(f"{self.given.agent.path}: does not fit its encoder ({reason})") from error

    def _check_domain(self) -> None:
        explored, actions = str(self.given.facts["task"]), int(self.given.facts["actions"])
        domain = domain_of(explored)
        if domain != domain_of(self.task) or actions != self.actions:
            raise UserError(
                f"--task {self.task}: has {self.actions} actions, the agent of {self.given.bundle} explored "
                f"{explored}, which has {actions}; choose a task of {domain}, or --agent fresh"
            )

    def _check_batch(self) -> None:
        """Only whole episodes are drawn from, and the last of the seed actions is still under way."""
        schedule, batch = self.schedule, self.options.batch_size
        there = (schedule.seed - 1) // schedule.episode * schedule.episode
        needed = (-(-batch // schedule.episode) * schedule.episode + 1) * self.action_repeat
        if batch > there:
            raise UserError(
                f"--batch_size {batch}: --seed_frames {self.options.seed_frames} are {there} transitions of whole "
                f"episodes; play at least {needed} seed frames, or choose a smaller batch"
            )

    def mean_actions(self, features: Tensor) -> Tensor:
        """(n, M) to (n, A)."""
        return self.agent.act(features)

    def values(self, features: Tensor, actions: Tensor) -> Tensor:
        """(n, M) and (n, A) to (n,)."""
        return self.agent.values_of(features, actions)

    def explore(self, observations: dict[str, np.ndarray], noise: np.ndarray) -> np.ndarray:
        """Actions (E, A) that explore, for latents (E, M) or pictures, and standard normal noise (E, A)."""
        with torch.no_grad():
            latents = self.frozen is not None
            seen = torch.from_numpy(observations[LATENTS]).to(self.device) if latents else self.features(observations)
            acted: np.ndarray = self.agent.act(seen, torch.from_numpy(noise).to(self.device)).cpu().numpy()
        if not np.isfinite(acted).all():
            raise Spoiled("an action is no number")
        return acted

    def learn(self, folder: Path, progress: OnlineProgress) -> None:
        """Play and learn; the replay lies in the folder, and is gone afterwards."""
        torch.manual_seed(self.options.seed)
        progress.add(0)
        with TemporaryDirectory(prefix=".replay-", dir=folder) as aside:
            collection = self._collection(Path(aside))
            try:
                for number in collection.updates(self.explore):
                    self.played = collection.steps * self.action_repeat
                    self.update(collection.replay.draw(number, self.options.batch_size))
                    if progress.is_due(self.played):
                        progress.add(self.played, self._told(collection))
                collection.finish(self.explore)
                self.played = collection.steps * self.action_repeat
                progress.add(self.played, self._told(collection))
            finally:
                collection.close()

    def _collection(self, folder: Path) -> Collection:
        options, schedule = self.options, self.schedule
        environment: gymnasium.Env[Any, Any]
        if self.frozen is None:
            environment, stack = self.environment, self.spec.frame_stack
            (name,) = self.spec.observations
            frame = environment.observation_space.shape
            assert frame is not None
            observations = {name: ArraySpec(frame)}
        else:
            environment, stack = EncodeObservation(self.environment, self.frozen), 1
            observations = {LATENTS: ArraySpec((self.width,), "float32")}
        plan = ReplayPlan(observations, self.actions, schedule.episodes, schedule.episode)
        replay = Replay(
            folder / "replay.h5",
            plan,
            n_steps=options.steps_of_returns,
            gamma=options.gamma,
            frame_stack=stack,
            seed=options.seed,
        )
        if self._start() != NEW:
            schedule = replace(schedule, random=0)
        return Collection([lambda: environment], replay, schedule, seed=options.seed)

    def update(self, batch: ReplayBatch) -> None:
        """One update of critic and trained features, actor and target.

        Raises:
            Spoiled: a loss or a value is not sound; nothing has followed it then.
        """
        self.last_good.offer()
        seen, later = self._features(batch)
        assert batch.actions is not None
        actions, returns, discounts = (part.to(self.device) for part in (batch.actions, batch.returns, batch.discounts))
        loss, value = self.agent.critic_loss(seen, later, actions, returns, discounts)
        check_sound({"critic": float(loss.detach()), "value": float(value)}, self.options.value_limit)
        self.last_good.accept()
        descend(loss, self.of_critic)
        of_actor = self.agent.actor_loss(seen)
        check_sound({"actor": float(of_actor.detach())}, self.options.value_limit)
        descend(of_actor, self.of_actor)
        self.agent.follow()
        self.latest = {"critic": loss.detach(), "value": value, "actor": of_actor.detach()}

    def _features(self, batch: ReplayBatch) -> tuple[Tensor, Tensor]:
        """(B, M) of t, with a gradient where they are trained, and of t + m."""
        moved = {name: array.to(self.device) for name, array in batch.observations.items()}
        if self.trained is None:
            return moved[LATENTS][:, 0], moved[LATENTS][:, 1]
        first, second = ({name: array[:, i] for name, array in moved.items()} for i in (0, 1))
        seen: Tensor = self.trained(first)
        return seen, self.trained.later(second)

    def _told(self, collection: Collection) -> Mapping[str, float]:
        returns, collection.returns = collection.returns, []
        found = {"return": float(np.mean(returns))} if returns else {}
        of_bottleneck = {} if self.trained is None else self.trained.latest
        return found | {name: float(value) for name, value in (self.latest | of_bottleneck).items()}

    def restore(self) -> None:
        """Go back to the last good actor and features."""
        self.last_good.restore()

    def save(self, folder: Path, encoder: Path | None) -> None:
        """Write ``policy.safetensors``, which :func:`~repdib_lightning.rl.policy_file.load_policy` reads."""
        tensors = {f"actor.{name}": value for name, value in self.agent.actor.state_dict().items()}
        if self.agent.statistics is not None:
            tensors |= {
                "standardise.mean": self.agent.statistics.mean,
                "standardise.scale": self.agent.statistics.scale,
            }
        facts = {"agent": self.options.algorithm, "encoder": None if encoder is None else str(encoder)}
        with whole_file(folder / POLICY) as aside:
            save_file(
                {name: value.detach().cpu().contiguous() for name, value in tensors.items()},
                aside,
                {"policy": json.dumps(facts)},
            )
