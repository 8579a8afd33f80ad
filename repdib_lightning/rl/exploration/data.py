"""The data module of an exploration: it steps environments, and draws from the replay that becomes of them."""

from __future__ import annotations

import copy
import os
from pathlib import Path
from typing import Any

import lightning.pytorch as pl
import numpy as np
import torch

from repdib_lightning.data.partial import partial_of
from repdib_lightning.data.schema import FactorSpec
from repdib_lightning.environments.control_background import Kind as Distractors
from repdib_lightning.environments.control_scene import Place, Quality
from repdib_lightning.errors import UserError
from repdib_lightning.records import ActionSpec, ArraySpec, DataSpec
from repdib_lightning.rl.exploration.collection import Act, Collection
from repdib_lightning.rl.exploration.environment import ControlFactory
from repdib_lightning.rl.exploration.loader import REPLAY, ExplorationLoader
from repdib_lightning.rl.exploration.replay import Replay, ReplayBatch, ReplayPlan
from repdib_lightning.rl.exploration.schedule import Schedule

VIEW = "pixels"
_EXAMPLE_ACTIONS = 8


class ExplorationDataModule(pl.LightningDataModule):
    """Environments that the model acts in without a reward, and the replay that its batches are drawn from.

    The replay is ``replay.h5`` in the run's folder: once the run is finished, a store that every verb opens, with the
    rewards of the task, which are not used, and the state of the environment as factors. Frames are control steps of
    all environments together: actions times the action repeat (URLB, Laskin et al. 2021; paper, continuous control).

    Args:
        task: such as ``walker-stand``; URLB explores walker-stand, quadruped-walk and jaco-reach_top_left.
        frames: in all; rounded up to whole episodes of all environments.
        snapshots: frames after which encoder and agent are kept for fine-tuning.
        batch_size: transitions an update (paper: 1024). frame_stack: S. image_size: height of the pictures in pixels.
        action_repeat: control steps an action is held for.
        environments: stepped together. processes: whether they have worker processes, as many as there are cores, so
            that they take their step while the model is updated.
        seed_frames: of random actions before the first update, at least an episode of each environment.
        update_every: actions between two updates.
        n_steps: between the two observations of a transition. gamma: discount.
        hold_out_every: every so many episodes one is marked for evaluation, as probes need, and never drawn; 0: none.
        quality, distractors, place, source, distractor_seed: see
            :class:`~repdib_lightning.environments.control_env.ControlEnv`.
        seed: of episodes, random actions and batches.

    Raises:
        UserError: a number out of range, or snapshots that the run does not reach.
    """

    def __init__(
        self,
        task: str = "walker-stand",
        frames: int = 2_000_000,
        snapshots: list[int] | None = None,
        batch_size: int = 256,
        frame_stack: int = 3,
        image_size: int = 84,
        action_repeat: int = 2,
        environments: int = 2,
        processes: bool = True,
        seed_frames: int = 4_000,
        update_every: int = 2,
        n_steps: int = 3,
        gamma: float = 0.99,
        hold_out_every: int = 10,
        quality: Quality = "fast",
        distractors: Distractors = "none",
        place: Place = "sky",
        source: str = "",
        distractor_seed: int = 0,
        seed: int = 0,
    ) -> None:
        super().__init__()
        self.task, self.frames, self.snapshots = task, frames, sorted(set(snapshots or []))
        self.batch_size, self.frame_stack, self.image_size = batch_size, frame_stack, image_size
        self.action_repeat, self.environments, self.processes = action_repeat, environments, processes
        self.seed_frames, self.update_every, self.n_steps, self.gamma = seed_frames, update_every, n_steps, gamma
        self.hold_out_every, self.seed = hold_out_every, seed
        self.scene: dict[str, Any] = {
            "quality": quality,
            "distractors": distractors,
            "place": place,
            "source": source,
            "distractor_seed": distractor_seed,
        }
        self._check()
        self.folder: Path | None = None
        self._spec: DataSpec | None = None
        self._loader: ExplorationLoader | None = None

    def _check(self) -> None:
        counts = ("frames", "batch_size", "frame_stack", "action_repeat", "environments", "update_every", "n_steps")
        for name in counts:
            if getattr(self, name) < 1:
                raise UserError(f"data.{name} must be at least 1, is {getattr(self, name)}")
        for name in ("seed_frames", "seed", "hold_out_every"):
            if getattr(self, name) < 0:
                raise UserError(f"data.{name} must not be negative, is {getattr(self, name)}")
        if self.seed >= 2**63:
            raise UserError(f"data.seed must be below 2^63, is {self.seed}")
        if self.hold_out_every == 1:
            raise UserError(
                "data.hold_out_every is 1: every episode would be held out; choose at least 2, or 0 for none"
            )
        if not 0.0 <= self.gamma <= 1.0:
            raise UserError(f"data.gamma must be from 0 to 1, is {self.gamma}")

    @property
    def environment(self) -> ControlFactory:
        """What opens one of the environments."""
        return ControlFactory(self.task, self.image_size, self.action_repeat, **self.scene)

    def setup(self, stage: str | None = None) -> None:
        """Open one environment to see what it is like, and plan the run.

        Raises:
            UserError: an unknown task, no renderer, unreadable distractors, or snapshots that the run does not reach.
        """
        if self._spec is not None:
            return
        environment = self.environment()
        task, shape = environment.task, environment.observation_space.shape
        assert shape is not None
        self.task, self.actions = task.name, task.actions
        states = {name: FactorSpec("endogenous", "continuous", width=n) for name, n in task.sizes.items()}
        self.schedule = Schedule.of_frames(
            frames=self.frames,
            action_repeat=self.action_repeat,
            episode=task.steps,
            environments=self.environments,
            seed_frames=self.seed_frames,
            update_every=self.update_every,
        )
        self.plan = ReplayPlan(
            {VIEW: ArraySpec(shape)},
            task.actions,
            self.schedule.episodes,
            task.steps,
            {**states, **environment.backgrounds.factor_specs()},
            self._attributes(),
            self.hold_out_every,
        )
        self._check_plan()
        self._example = self._play(environment)
        environment.close()
        stacked = ArraySpec((shape[0] * self.frame_stack, *shape[1:]))
        actions = ActionSpec("continuous", task.actions)
        self._spec = DataSpec({VIEW: stacked}, actions, self.frame_stack, self.n_steps)

    def _attributes(self) -> dict[str, Any]:
        told = {"task": self.task, "behaviour": "exploration", "image_size": self.image_size}
        told |= {"action_repeat": self.action_repeat, "seed": self.seed, **self.scene}
        licence = "generated; models from dm-control (Apache-2.0)"
        return {"environment": "control", "configuration": told, "seed": self.seed, "licence": licence}

    def _check_plan(self) -> None:
        if not self.schedule.updates:
            first = self.schedule.seed * self.action_repeat
            raise UserError(f"data.frames is {self.frames}: the first update comes after {first} frames; choose more")
        last = self.schedule.total * self.action_repeat
        for frames in self.snapshots:
            if not self.schedule.seed * self.action_repeat < frames <= last:
                first = self.schedule.seed * self.action_repeat
                raise UserError(
                    f"data.snapshots: {frames} is not between the first update ({first}) and the end ({last})"
                )
        drawn = sum(not self.plan.is_held_out(episode) for episode in range(self.schedule.episodes_at_first))
        if self.batch_size > drawn * self.plan.steps:
            raise UserError(
                f"data.batch_size is {self.batch_size}: at the first update there are {drawn * self.plan.steps} "
                "transitions; choose fewer, or more environments"
            )

    def _play(self, environment: Any) -> ReplayBatch:
        """Two transitions of random actions."""
        random = np.random.default_rng(0)
        frames, actions = [environment.reset(seed=0)[0]], random.uniform(-1.0, 1.0, (_EXAMPLE_ACTIONS, self.actions))
        frames += [environment.step(action)[0] for action in actions]
        stacks = [np.concatenate([frames[max(i - s, 0)] for s in range(self.frame_stack)][::-1]) for i in (0, 4, 4, 8)]
        pairs = torch.from_numpy(np.stack(stacks)).unflatten(0, (2, 2))
        return ReplayBatch(
            observations={VIEW: pairs},
            actions=torch.from_numpy(actions[[0, 4]].astype(np.float32)),
            offsets=torch.tensor([[0, self.n_steps]] * 2),
            rows=torch.tensor([0, 4]),
            returns=torch.zeros(2),
            discounts=torch.full((2,), self.gamma**self.n_steps),
        )

    @property
    def spec(self) -> DataSpec:
        """What a model must know. Only after :meth:`setup`."""
        assert self._spec is not None, "setup() opens an environment first"
        return self._spec

    @property
    def facts(self) -> dict[str, Any]:
        """Plain facts of the data for a run's folder and for bundles."""
        return {"file": REPLAY, "fingerprint": ""}

    def example(self, count: int = 2) -> ReplayBatch:
        """Two transitions of random actions. Only after :meth:`setup`."""
        return copy.deepcopy(self._example)

    def train_dataloader(self) -> ExplorationLoader:
        """Batches from the replay, one an update; taking the next one steps the environments."""
        if self._loader is None:
            self._loader = ExplorationLoader(self)
        return self._loader

    def act(self, observations: dict[str, np.ndarray], noise: np.ndarray) -> np.ndarray:
        """What the model that is trained does, (E, A)."""
        assert self.trainer is not None
        policy: Act = self.trainer.lightning_module.act  # type: ignore[assignment]
        with self.trainer.precision_plugin.forward_context():
            return policy(observations, noise)

    @property
    def frames_done(self) -> int:
        """Frames so far."""
        return self.train_dataloader().steps * self.action_repeat

    @property
    def replay(self) -> Replay | None:
        """The replay; None before the first batch."""
        return None if self._loader is None or self._loader.collection is None else self._loader.collection.replay

    def take_returns(self) -> list[float]:
        """The task's returns of the episodes that have ended since this was last asked."""
        if self._loader is None or self._loader.collection is None:
            return []
        returns = list(self._loader.collection.returns)
        self._loader.collection.returns.clear()
        return returns

    def open_collection(self, keep: int | None) -> Collection:
        """Open environments and replay; going on after ``keep`` episodes."""
        assert self.folder is not None, "the run's folder is not known"
        os.environ.setdefault("LP_NUM_THREADS", "0")  # worker processes draw by themselves
        path = self.folder / REPLAY
        if keep is not None and path.exists():  # the run was finished, and has lost its last checkpoint since
            os.replace(path, partial_of(path))
        replay = Replay(
            path,
            self.plan,
            n_steps=self.n_steps,
            gamma=self.gamma,
            frame_stack=self.frame_stack,
            seed=self.seed,
            keep=keep,
        )
        try:
            openers = [self.environment] * self.environments
            return Collection(openers, replay, self.schedule, seed=self.seed, processes=self.processes)
        except BaseException:
            replay.close()
            raise

    def teardown(self, stage: str | None = None) -> None:
        """Take what actions are left, and publish the replay if the run is at its end."""
        if stage == "fit" and self._loader is not None:
            self._loader.finish()

    def close(self) -> None:
        """Close environments and replay, wherever the run stands."""
        if self._loader is not None:
            self._loader.close()
