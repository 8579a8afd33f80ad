"""A replay that is a data set: episodes are written into a store, and drawn from while it grows."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from repdib_lightning.data.schema import FactorSpec
from repdib_lightning.data.writer import EpisodeWriter
from repdib_lightning.errors import UserError
from repdib_lightning.records import ActionSpec, ArraySpec, Batch

_SEED_OF_BATCHES = 2**63
"""Apart from what episodes and actions are drawn with."""


@dataclass(frozen=True)
class ReplayPlan:
    """What a replay will hold, stated before the first episode.

    Attributes:
        observations: name -> un-stacked observation. actions: A.
        episodes: E. steps: actions of every episode, T; it has T + 1 rows.
        factors: ground truth. attributes: of the file.
        hold_out_every: every so many episodes the last one is marked for evaluation and never drawn; 0 for none.
    """

    observations: dict[str, ArraySpec]
    actions: int
    episodes: int
    steps: int
    factors: dict[str, FactorSpec] = field(default_factory=dict)
    attributes: Mapping[str, Any] = field(default_factory=dict)
    hold_out_every: int = 0

    def is_held_out(self, episode: int) -> bool:
        """Whether an episode is for evaluation only."""
        return bool(self.hold_out_every) and episode % self.hold_out_every == self.hold_out_every - 1


@dataclass(kw_only=True)
class ReplayBatch(Batch):
    """Transitions over m steps: ``observations`` are (B, 2, *shape), at t and at t + m; ``offsets`` are 0 and m.

    Attributes:
        returns: (B,) discounted rewards of the m steps. discounts: (B,) gamma^m; the value of t is
            ``returns + discounts * value(t + m)``.
    """

    returns: Tensor
    discounts: Tensor


class Replay:
    """Every transition of a run, in a usual store, un-stacked, memory-mapped; only whole episodes are drawn from.

    The file is ``.NAME.partial`` until :meth:`finish`, and readable throughout. Near the end of an episode m is what is
    left of it; episodes end by their time limit, so that the value of the last observation always counts.

    Args:
        path: the store. plan: what it will hold.
        n_steps: n, steps of a return. gamma: discount. frame_stack: S of what is drawn.
        seed: a batch is a function of it, of its number, and of how many episodes there are.
        keep: go on after this many episodes of an interrupted run, and forget later ones; None begins anew.

    Raises:
        UserError: the file cannot be written, or an interrupted one does not fit.
    """

    def __init__(
        self,
        path: Path,
        plan: ReplayPlan,
        *,
        n_steps: int = 3,
        gamma: float = 0.99,
        frame_stack: int = 1,
        seed: int = 0,
        keep: int | None = None,
    ) -> None:
        self.plan, self.path = plan, path
        self.n_steps, self.gamma, self.frame_stack, self.seed = n_steps, gamma, frame_stack, seed
        self._writer = EpisodeWriter(
            path,
            rows=plan.episodes * (plan.steps + 1),
            episodes=plan.episodes,
            observations=plan.observations,
            actions=ActionSpec("continuous", plan.actions),
            factors=plan.factors,
            rewards=True,
            attributes=dict(plan.attributes),
            overwrite=keep is None,
            resume=True,
            keep=keep,
            goes_on=f"fit --resume {path.parent}",
        )
        self._arrays = self._writer.arrays()

    @property
    def episodes(self) -> int:
        """Whole episodes that are there."""
        return self._writer.episodes_done

    @property
    def _drawn_from(self) -> np.ndarray:
        done = np.arange(self.episodes)
        every = self.plan.hold_out_every
        return done[done % every != every - 1] if every else done

    def __len__(self) -> int:
        """Transitions that can be drawn."""
        return len(self._drawn_from) * self.plan.steps

    def add(self, episode: Mapping[str, Any]) -> None:
        """Append an episode: ``observations``, ``actions``, ``rewards`` and ``factors`` of T + 1 or T rows.

        Raises:
            UserError: it cannot be written.
        """
        steps = self.plan.steps
        ends = np.zeros(steps, bool)
        ends[-1] = True
        held_out = self.plan.is_held_out(self.episodes)
        self._writer.add_episode(**episode, terminations=np.zeros(steps, bool), truncations=ends, evaluation=held_out)

    def gather(self, key: str, episode: int, places: np.ndarray | None = None) -> np.ndarray:
        """Rows of a key of the store, such as ``factors/height``, at places of an episode; all T + 1 by default."""
        rows = self.plan.steps + 1
        return self._arrays.gather(key, episode * rows + (np.arange(rows) if places is None else places))

    def draw(self, number: int, batch_size: int) -> ReplayBatch:
        """A batch.

        Raises:
            UserError: there are fewer transitions.
        """
        if len(self) < batch_size:
            raise UserError(f"{self.path}: holds {len(self)} transitions, a batch of {batch_size} cannot be drawn yet")
        random = np.random.Generator(np.random.Philox(key=np.array([self.seed, _SEED_OF_BATCHES + number], np.uint64)))
        steps = self.plan.steps
        episodes, at = np.divmod(random.integers(len(self), size=batch_size), steps)
        starts = self._drawn_from[episodes] * (steps + 1)
        ahead = np.minimum(self.n_steps, steps - at)
        observations = {name: self._stacks(name, starts, at, ahead) for name in self.plan.observations}
        return ReplayBatch(
            observations=observations,
            actions=torch.from_numpy(self._arrays.gather("actions", starts + at)),
            offsets=torch.from_numpy(np.stack([np.zeros_like(ahead), ahead], axis=1)),
            rows=torch.from_numpy(starts + at),
            returns=torch.from_numpy(self._returns(starts, at, ahead)),
            discounts=torch.from_numpy((self.gamma**ahead).astype(np.float32)),
        )

    def _stacks(self, name: str, starts: np.ndarray, at: np.ndarray, ahead: np.ndarray) -> Tensor:
        """(B, 2, S * C, ...) of t and t + m; before an episode's start its first frame is repeated."""
        newest = np.stack([at, at + ahead], axis=1)
        places = np.maximum(newest[..., None] - np.arange(self.frame_stack - 1, -1, -1), 0)
        rows = starts[:, None, None] + places
        frames = self._arrays.gather(f"observations/{name}", rows.reshape(-1))
        return torch.from_numpy(frames.reshape(len(at), 2, -1, *frames.shape[2:]))

    def _returns(self, starts: np.ndarray, at: np.ndarray, ahead: np.ndarray) -> np.ndarray:
        steps = np.arange(self.n_steps)
        rows = starts[:, None] + np.minimum(at[:, None] + steps, self.plan.steps - 1)
        rewards = self._arrays.gather("rewards", rows.reshape(-1)).reshape(rows.shape)
        counted = steps < ahead[:, None]
        found: np.ndarray = (rewards * self.gamma**steps * counted).sum(1).astype(np.float32)
        return found

    def finish(self) -> None:
        """Publish the store, once all its episodes are there. Raises UserError where some are missing."""
        self._writer.__exit__(None, None, None)

    def close(self) -> None:
        """Leave the store unfinished, to be gone on with."""
        self._writer.close()
