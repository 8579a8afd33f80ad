"""Several environments that are stepped together, and the episodes that become of it, in between updates."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np
import torch

from repdib_lightning.errors import UserError
from repdib_lightning.rl.exploration.episode import Episode
from repdib_lightning.rl.exploration.replay import Replay, ReplayPlan
from repdib_lightning.rl.exploration.schedule import Schedule
from repdib_lightning.rl.exploration.stepping import Moved, Opener, stepper

Act = Callable[[dict[str, np.ndarray], np.ndarray], np.ndarray]
"""Observations name -> (E, *stacked shape) and standard normal noise (E, A), to actions (E, A)."""

_SEED_OF_EPISODES, _SEED_OF_ACTIONS = 0, 1


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
        processes: True for worker processes, as many as there are cores.

    Attributes:
        returns: sum of the rewards of each episode that has ended since they were last taken.

    Raises:
        UserError: an environment whose episodes have another length than planned, or that dies.
    """

    def __init__(
        self,
        environments: Sequence[Opener],
        replay: Replay,
        schedule: Schedule,
        *,
        seed: int,
        processes: bool = False,
    ) -> None:
        self.replay, self.schedule, self.seed = replay, schedule, seed
        self._environments = stepper(environments, processes)
        self._pending = False
        self._playing: list[Episode] = []
        self._taken = np.zeros(
            (0, 0, 0), np.float32
        )  # their actions, (E, T, A): the state is asked for at every update
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
        self._taken = np.zeros((self.schedule.environments, self.plan.steps, self.plan.actions), np.float32)
        if seeds is None:
            key = self._key(_SEED_OF_EPISODES, self.steps)
            drawn = np.random.Generator(np.random.Philox(key=key)).integers(2**31, size=self.schedule.environments)
            seeds = [int(seed) for seed in drawn]
        self._playing = [
            Episode(seed, {name: [row] for name, row in self._rows(begun).items()}, [self._factors(begun)])
            for seed, begun in zip(seeds, self._environments.reset(seeds), strict=True)
        ]

    def _send(self, actions: np.ndarray) -> None:
        self._taken[:, self._length] = actions
        for episode, action in zip(self._playing, actions, strict=True):
            episode.actions.append(action)
        self.steps += len(actions)
        self._environments.send(actions)
        self._pending = True

    def _receive(self) -> None:
        """Take what the last step gave, and put episodes that it ended into the replay."""
        if not self._pending:
            return
        self._pending = False
        moved = self._environments.receive()
        for episode, after in zip(self._playing, moved, strict=True):
            for name, row in self._rows(after).items():
                episode.frames[name].append(row)
            episode.factors.append(self._factors(after))
            episode.rewards.append(after.reward)
        if self._length == self.plan.steps or any(m.terminated or m.truncated for m in moved):
            self._end(moved)

    def _end(self, moved: Sequence[Moved]) -> None:
        length, planned = self._length, self.plan.steps
        if any(m.terminated or not m.truncated for m in moved) or length != planned:
            raise UserError(
                f"an episode ended after {length} actions, all are planned to be cut off after {planned}; choose a "
                "task whose episodes end by their time limit alone"
            )
        for episode in self._playing:
            self.replay.add(episode.as_stored())
            self.returns.append(float(np.sum(episode.rewards)))
        self._playing = []

    def _rows(self, moved: Moved) -> dict[str, np.ndarray]:
        names = list(self.plan.observations)
        return {name: moved.shown[name] for name in names} if isinstance(moved.shown, dict) else {names[0]: moved.shown}

    def _factors(self, moved: Moved) -> dict[str, np.ndarray]:
        return {name: moved.factors[name] for name in self.plan.factors}

    def state_dict(self) -> dict[str, Any]:
        """Counts, and seeds and actions of the episodes under way."""
        return {
            "steps": self.steps,
            "updates": self.updates_done,
            "episodes": self.replay.episodes,
            "seeds": [episode.seed for episode in self._playing],
            "actions": torch.from_numpy(self._taken[:, : self._length].copy()),
        }

    @property
    def _length(self) -> int:
        """Actions of the episodes under way."""
        return len(self._playing[0].actions) if self._playing else 0

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Go on where a state was taken: the replay holds its episodes, those under way are played again."""
        assert self.replay.episodes == state["episodes"] and not self._playing
        self.steps, self.updates_done = state["steps"], state["updates"]
        if state["seeds"]:
            self._begin(state["seeds"])
            done = state["actions"].numpy()
            self.steps -= done.shape[0] * done.shape[1]
            for step in range(done.shape[1]):
                self._receive()
                self._send(done[:, step])
        assert self.steps == state["steps"]

    def close(self) -> None:
        """Close environments and replay, whatever has become of worker processes."""
        try:
            self._environments.close()
        finally:
            self.replay.close()
