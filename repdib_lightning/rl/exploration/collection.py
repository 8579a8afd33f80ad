"""Several environments that are stepped together, and the episodes that become of it, in between updates."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any

import gymnasium
import numpy as np
import torch
from gymnasium.vector import AsyncVectorEnv, AutoresetMode, SyncVectorEnv

from repdib_lightning.errors import UserError
from repdib_lightning.rl.exploration.replay import Replay, ReplayPlan

Act = Callable[[dict[str, np.ndarray], np.ndarray], np.ndarray]
"""Observations name -> (E, *stacked shape) and standard normal noise (E, A), to actions (E, A)."""

_SEED_OF_EPISODES, _SEED_OF_ACTIONS = 0, 1


class DeadWorker(UserError):
    """A worker process does not answer."""


@dataclass(frozen=True)
class Schedule:
    """When environments are stepped, and when agents are updated; counts of actions of all environments together.

    Attributes:
        environments: E, stepped together. episode: actions of one, T.
        total: actions in all. seed: before the first update. update_every: between two updates.
        random: of the first ones, which are drawn evenly; the policy is asked for all later ones.
    """

    environments: int
    episode: int
    total: int
    seed: int
    update_every: int
    random: int

    @classmethod
    def of_frames(
        cls, *, frames: int, action_repeat: int, episode: int, environments: int, seed_frames: int, update_every: int
    ) -> Schedule:
        """From counts of frames, each of which is a control step of an environment.

        All environments play whole episodes, so that there may be more frames than asked for. No update comes before
        the first episodes are in the replay.
        """
        together = environments * episode
        total = math.ceil(frames / (together * action_repeat)) * together
        seed = max(math.ceil(seed_frames / action_repeat), together + environments)
        return cls(environments, episode, total, seed, update_every, seed)

    @property
    def episodes(self) -> int:
        """Of all environments."""
        return self.total // self.episode

    @property
    def updates(self) -> int:
        """Until the last action."""
        return max(0, self.total - self.seed) // self.update_every

    @property
    def episodes_at_first(self) -> int:
        """Whole ones in the replay at the first update; the step under way is not in yet."""
        return (math.ceil(self.seed / self.environments) - 1) // self.episode * self.environments

    def actions_before(self, update: int) -> int:
        """How many actions have been taken when an update (from 0 on) is due."""
        return self.seed + update * self.update_every


@dataclass
class Episode:
    """An episode that an environment is playing.

    Attributes:
        seed: of its beginning. frames: name -> (1, ...) rows of observations. actions, rewards, factors: so far.
    """

    seed: int
    frames: dict[str, list[np.ndarray]]
    factors: list[dict[str, np.ndarray]]
    actions: list[np.ndarray] = field(default_factory=list)
    rewards: list[float] = field(default_factory=list)

    def stacked(self, name: str, stack: int) -> np.ndarray:
        """(S * C, ...) of the newest frames; the first one is repeated where there are fewer."""
        frames = self.frames[name]
        places = range(len(frames) - stack, len(frames))
        return frames[-1] if stack == 1 else np.concatenate([frames[max(place, 0)] for place in places])

    def as_stored(self) -> dict[str, Any]:
        """Arguments of :meth:`Replay.add`."""
        names = self.factors[0]
        factors = {name: np.stack([row[name] for row in self.factors]) for name in names}
        return {
            "observations": {name: np.stack(rows) for name, rows in self.frames.items()},
            "actions": np.stack(self.actions),
            "rewards": np.array(self.rewards, np.float32),
            "factors": {name: values[:, 0] if values.shape[1:] == (1,) else values for name, values in factors.items()},
        }


class Collection:
    """Steps E environments and puts what they show into a replay.

    What happens depends on the seed, the schedule and the policy alone. With worker processes an update runs while the
    environments take their step; without, the order is the same. A state remembers seeds and actions of the episodes
    under way: going on, these are played again, which takes seconds and needs nothing of the simulator but that it
    repeats itself.

    Args:
        environments: what opens each of them; they show single frames, as one ``Box`` or a ``Dict`` by name, and may
            tell ``info["factors"]``.
        replay: its plan has the observations that are kept.
        schedule: see there.
        seed: of all episodes and random actions.
        processes: True for a worker process an environment.

    Attributes:
        returns: sum of the rewards of each episode that has ended since they were last taken.

    Raises:
        UserError: an environment whose episodes have another length than planned, or that dies.
    """

    def __init__(
        self,
        environments: Sequence[Callable[[], gymnasium.Env[Any, Any]]],
        replay: Replay,
        schedule: Schedule,
        *,
        seed: int,
        processes: bool = False,
    ) -> None:
        self.replay, self.schedule, self.seed = replay, schedule, seed
        manual: dict[str, Any] = {"autoreset_mode": AutoresetMode.DISABLED, "copy": True}
        self._processes, self._pending = processes, False
        with _living_workers():
            self._vector: Any = (
                AsyncVectorEnv(environments, context="spawn", **manual)
                if processes
                else SyncVectorEnv(environments, **manual)
            )
        self._playing: list[Episode] = []
        self._sent = np.zeros(0)
        self.steps = self.updates_done = 0
        self.returns: list[float] = []

    @property
    def plan(self) -> ReplayPlan:
        """Of the replay."""
        return self.replay.plan

    def advance(self, act: Act) -> None:
        """Step the environments until the next update is due; the last step is left under way.

        Args:
            act: the policy, asked once the random actions are over.
        """
        due = self.schedule.actions_before(self.updates_done)
        while self.steps < due:
            self._step(act)
        self.updates_done += 1

    def finish(self, act: Act) -> None:
        """Take the actions that are left after the last update."""
        while self.steps < self.schedule.total:
            self._step(act)
        self._receive()

    def _step(self, act: Act) -> None:
        self._receive()
        if not self._playing:
            self._begin()
        self._send(self._actions(act))

    def updates(self, act: Act) -> Iterator[int]:
        """Numbers of the updates that are left; before each one the environments have been stepped."""
        while self.updates_done < self.schedule.updates:
            self.advance(act)
            yield self.updates_done - 1

    def _actions(self, act: Act) -> np.ndarray:
        """(E, A) float32: random ones at first, then those of the policy."""
        random = np.random.Generator(np.random.Philox(key=self._key(_SEED_OF_ACTIONS, self.steps)))
        shape = (len(self._playing), self.plan.actions)
        if self.steps < self.schedule.random:
            return random.uniform(-1.0, 1.0, shape).astype(np.float32)
        return np.asarray(act(self.observations(), random.standard_normal(shape).astype(np.float32)), np.float32)

    def _key(self, purpose: int, number: int) -> np.ndarray:
        return np.array([self.seed, 2 * number + purpose], np.uint64)

    def observations(self) -> dict[str, np.ndarray]:
        """Name -> (E, *stacked shape): what the environments show."""
        stack = self.replay.frame_stack
        return {
            name: np.stack([episode.stacked(name, stack) for episode in self._playing])
            for name in self.plan.observations
        }

    def _begin(self, seeds: Sequence[int] | None = None) -> None:
        """Begin an episode in every environment."""
        if seeds is None:
            key = self._key(_SEED_OF_EPISODES, self.steps)
            drawn = np.random.Generator(np.random.Philox(key=key)).integers(2**31, size=self.schedule.environments)
            seeds = [int(seed) for seed in drawn]
        with _living_workers():
            shown, info = self._vector.reset(seed=list(seeds))
        frames, factors = self._rows(shown), self._factors(info)
        self._playing = [
            Episode(seed, {name: [rows[i]] for name, rows in frames.items()}, [factors[i]])
            for i, seed in enumerate(seeds)
        ]

    def _send(self, actions: np.ndarray) -> None:
        for episode, action in zip(self._playing, actions, strict=True):
            episode.actions.append(action)
        self._sent = actions
        self.steps += len(actions)
        if self._processes:
            with _living_workers():
                self._vector.step_async(actions)
        self._pending = True

    def _receive(self) -> None:
        """Take what the last step gave, and put episodes that it ended into the replay."""
        if not self._pending:
            return
        self._pending = False
        with _living_workers():
            moved = self._vector.step_wait() if self._processes else self._vector.step(self._sent)
        shown, rewards, terminated, truncated, info = moved
        frames, factors = self._rows(shown), self._factors(info)
        for i, episode in enumerate(self._playing):
            for name, rows in frames.items():
                episode.frames[name].append(rows[i])
            episode.factors.append(factors[i])
            episode.rewards.append(float(rewards[i]))
        if len(self._playing[0].actions) == self.plan.steps or (terminated | truncated).any():
            self._end(terminated, truncated)

    def _end(self, terminated: np.ndarray, truncated: np.ndarray) -> None:
        length, planned = len(self._playing[0].actions), self.plan.steps
        if terminated.any() or not truncated.all() or length != planned:
            raise UserError(
                f"an episode ended after {length} actions, all are planned to be cut off after {planned}; choose a "
                "task whose episodes end by their time limit alone"
            )
        for episode in self._playing:
            self.replay.add(episode.as_stored())
            self.returns.append(float(np.sum(episode.rewards)))
        self._playing = []

    def _rows(self, shown: Any) -> dict[str, np.ndarray]:
        names = list(self.plan.observations)
        return {name: shown[name] for name in names} if isinstance(shown, dict) else {names[0]: shown}

    def _factors(self, info: dict[str, Any]) -> list[dict[str, np.ndarray]]:
        told = info.get("factors", {})
        return [{name: told[name][i] for name in self.plan.factors} for i in range(self.schedule.environments)]

    def state_dict(self) -> dict[str, Any]:
        """Counts, and seeds and actions of the episodes under way."""
        actions = np.stack([np.stack(episode.actions) for episode in self._playing]) if self._begun else np.zeros(0)
        return {
            "steps": self.steps,
            "updates": self.updates_done,
            "episodes": self.replay.episodes,
            "seeds": [episode.seed for episode in self._playing],
            "actions": torch.from_numpy(actions.astype(np.float32)),
        }

    @property
    def _begun(self) -> bool:
        return bool(self._playing) and bool(self._playing[0].actions)

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Go on where a state was taken: the replay holds its episodes, those under way are played again."""
        assert self.replay.episodes == state["episodes"] and not self._playing
        self.steps, self.updates_done = state["steps"], state["updates"]
        if state["seeds"]:
            self._begin(state["seeds"])
            done = state["actions"].numpy()
            self.steps -= done[..., 0].size
            for step in range(done.shape[1]):
                self._receive()
                self._send(done[:, step])
        assert self.steps == state["steps"]

    def close(self) -> None:
        """Close environments and replay, whatever has become of worker processes."""
        pending, self._pending = self._pending and self._processes, False
        try:
            if all(process.is_alive() for process in self._workers):
                if pending:
                    self._vector.step_wait()
                self._vector.close()
        except (EOFError, ConnectionError, KeyboardInterrupt):  # they were killed, or interrupted as this process was
            pass
        finally:
            for process in self._workers:
                process.terminate()
                process.join()
            self._vector.closed = True
            self.replay.close()

    @property
    def _workers(self) -> list[Any]:
        return self._vector.processes if self._processes else []


@contextmanager
def _living_workers() -> Iterator[None]:
    """Say so where a worker process does not answer."""
    try:
        yield
    except (EOFError, ConnectionError) as error:
        raise DeadWorker("a worker process that steps an environment has ended; was it killed?") from error
