"""Transitions of a store for offline agents: n-step returns by index arithmetic, and batches of them."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import torch
from torch import Tensor

from repdib_lightning.data.episodes import EpisodeStore
from repdib_lightning.errors import UserError

Seen = Tensor | dict[str, Tensor]
"""What an agent's encoder takes: latents (B, M), or observations name -> (B, *shape)."""


@dataclass
class TransitionBatch:
    """Attributes: seen, later: what is seen at t and at t + m. actions: (B, A) float32, at t. returns, discounts: (B,)
    float32; the value of t is ``returns + discounts * value(later)``."""

    seen: Seen
    later: Seen
    actions: Tensor
    returns: Tensor
    discounts: Tensor


class RowSource(Protocol):
    """Where what is seen at rows of a store comes from."""

    def rows(self, rows: np.ndarray, random: np.random.Generator) -> Seen:
        """What is seen at these rows, (n,) int64; a source may draw one of several augmented copies."""
        ...


class Transitions:
    """Every action of the training episodes, with the return of the next m = n steps.

    Near the end of an episode m is what is left of it; the value of the last observation counts where the episode was
    truncated, and not where it terminated. V-D4RL's program leaves such windows out; with n = 3 these are 2 of 500.

    Args:
        store: with continuous actions.
        n_steps: n.
        gamma: discount.
        rewarded: whether rewards are needed; without, returns are zero.

    Attributes:
        rows, later: (N,) int64, t and t + m. returns, discounts: (N,) float32.

    Raises:
        UserError: no continuous actions in [-1, 1], or no finite rewards where they are needed.
    """

    def __init__(self, store: EpisodeStore, *, n_steps: int = 1, gamma: float = 0.99, rewarded: bool = True) -> None:
        if store.actions_spec is None or store.actions_spec.kind != "continuous":
            kind = "there are none" if store.actions_spec is None else f"these are {store.actions_spec.kind}"
            raise UserError(f"{store.path}: offline agents need continuous actions, {kind}")
        if rewarded and "rewards" not in store:
            raise UserError(f"{store.path}: has no 'rewards', which this agent learns from; `finetune bc` needs none")
        chosen = store.episodes("train")
        starts, lengths = store.starts[chosen], store.lengths[chosen]
        parts = [np.arange(s, s + n - 1) for s, n in zip(starts, lengths, strict=True)]
        self.rows = np.concatenate([np.arange(0), *parts])
        _check_bounds(store, self.rows)
        last = np.repeat(starts + lengths - 1, lengths - 1)
        self.later = np.minimum(self.rows + n_steps, last)
        self.path = store.path
        self.returns = np.zeros(len(self.rows), np.float32)
        self.discounts = (gamma ** (self.later - self.rows)).astype(np.float32)
        if not rewarded:
            return
        rewards = _of_rows(store, "rewards").astype(np.float32)
        bad = np.flatnonzero(~np.isfinite(rewards[self.rows]))
        if len(bad):
            raise UserError(
                f"{store.path}: 'rewards' is NaN or infinite at row {self.rows[bad[0]]}; {len(bad)} such rows"
            )
        for ahead in range(n_steps):
            inside = self.rows + ahead < last
            self.returns[inside] += gamma**ahead * rewards[self.rows[inside] + ahead]
        if "terminations" in store:
            ended = _of_rows(store, "terminations").astype(bool)
            self.discounts[(self.later == last) & ended[last - 1]] = 0.0

    def __len__(self) -> int:
        return len(self.rows)

    def check_batch(self, batch_size: int) -> None:
        """Raise UserError where a batch is larger than the data."""
        if batch_size > len(self):
            raise UserError(f"--batch_size {batch_size}: {self.path} has {len(self)} transitions to train on")


def _of_rows(store: EpisodeStore, name: str) -> np.ndarray:
    """(N,) of a key, whatever another program wrote it as."""
    array = np.asarray(store.array(name)[:])
    if array.size != store.rows:
        raise UserError(f"{store.path}: '{name}' has shape {array.shape}, expected ({store.rows},)")
    return array.reshape(-1)


def _check_bounds(store: EpisodeStore, rows: np.ndarray) -> None:
    """What an actor gives is in [-1, 1]; it cannot repeat anything else."""
    largest = float(np.abs(store.gather("actions", rows)).max(initial=0.0))
    if not largest <= 1.0 + 1e-6:
        raise UserError(f"{store.path}: offline agents need actions in [-1, 1], here is one of size {largest:.4g}")


class TransitionBatches:
    """A fixed number of batches, each a function of (seed, its number) alone.

    Args:
        store, transitions: the data.
        source: what is seen at a row.
        batch_size: B.
        steps: batches.
        seed: of the draws.
    """

    def __init__(
        self, store: EpisodeStore, transitions: Transitions, source: RowSource, batch_size: int, steps: int, seed: int
    ) -> None:
        self.transitions, self.source = transitions, source
        self.batch_size, self.steps, self.seed = batch_size, steps, seed
        self.actions = np.asarray(store.gather("actions", transitions.rows), np.float32)

    def __len__(self) -> int:
        return self.steps

    def __iter__(self) -> Iterator[TransitionBatch]:
        for number in range(self.steps):
            yield self.batch(number)

    def batch(self, number: int) -> TransitionBatch:
        """One batch."""
        random = np.random.Generator(np.random.Philox(key=np.array([self.seed, number], np.uint64)))
        places = random.integers(len(self.transitions), size=self.batch_size)
        every = self.transitions
        return TransitionBatch(
            self.source.rows(every.rows[places], random),
            self.source.rows(every.later[places], random),
            torch.from_numpy(self.actions[places]),
            torch.from_numpy(every.returns[places]),
            torch.from_numpy(every.discounts[places]),
        )
