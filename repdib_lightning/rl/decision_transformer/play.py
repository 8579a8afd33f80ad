"""Acts as a return asks for: what a trained network does in one or several episodes at once."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor

from repdib_lightning.errors import UserError
from repdib_lightning.export.observations import Observations
from repdib_lightning.rl.decision_transformer.cache import CachedContext
from repdib_lightning.rl.decision_transformer.network import DecisionTransformer

Encode = Callable[[Observations], Tensor]
"""Observations (n, *shape), or of one episode (*shape), to what the network takes as states, (n, ...) or (...)."""


class Play:
    """Episodes from their first step on; each step asks for what is left of the target return.

    Args:
        network: in evaluation mode.
        encode: what is seen to states.
        episodes: n, played in step.
        target_return: what is asked for at the start.
        temperature: of the actions that are drawn; 0 takes the likeliest.
        seed: of the draws; each episode has its own, whatever becomes of the others.
    """

    def __init__(
        self,
        network: DecisionTransformer,
        encode: Encode,
        *,
        episodes: int,
        target_return: float,
        temperature: float,
        seed: int,
    ) -> None:
        assert not network.training
        self._encode, self._temperature = encode, temperature
        self._context = CachedContext(network, episodes)
        self._device = network.positions.device
        self._to_go = np.full(episodes, target_return, np.float64)
        self._taken: Tensor | None = None
        keys = [np.array([seed, episode], np.uint64) for episode in range(episodes)]
        self._random = [np.random.Generator(np.random.Philox(key=key)) for key in keys]

    @torch.inference_mode()
    def act(self, observations: Observations, rewards: np.ndarray | float | None = None) -> np.ndarray:
        """Take the next action of each episode.

        Args:
            observations: what is seen now, stacked as the encoder's spec says: name -> (n, *shape), or the bare array
                where the spec has one; (*shape) for a single episode.
            rewards: (n,) of the actions before, or a number; None in the first step.

        Returns:
            (n,) int64.

        Raises:
            UserError: observations or rewards that do not fit; rewards in the first step, or none in a later one.
        """
        self._check_rewards(rewards)
        states = self._encode(observations)
        states = states.unsqueeze(0) if states.ndim == 1 else states
        if len(states) != len(self._to_go):
            raise UserError(f"{len(states)} observations were given, {len(self._to_go)} episodes are played")
        if rewards is not None:
            self._to_go = self._to_go - rewards
        to_go = torch.from_numpy(self._to_go.astype(np.float32)).to(self._device)
        logits = self._context.step(states, to_go, self._taken).double().cpu()
        chosen = logits.argmax(-1).numpy() if self._temperature == 0 else self._draw(logits)
        self._taken = torch.from_numpy(chosen.copy()).to(self._device)
        return chosen

    def keep(self, places: np.ndarray) -> None:
        """Go on with some of the episodes, (m,) int64, since the others have ended."""
        chosen = torch.from_numpy(places).to(self._device)
        self._context.keep(chosen)
        self._to_go = self._to_go[places]
        self._taken = None if self._taken is None else self._taken[chosen]
        self._random = [self._random[place] for place in places]

    def _check_rewards(self, rewards: np.ndarray | float | None) -> None:
        if (rewards is None) != (self._taken is None):
            wanted = "takes no rewards" if self._taken is None else "needs the rewards of the actions before"
            raise UserError(f"this step {wanted}; begin another play for other episodes")
        if rewards is not None and np.shape(rewards) not in ((), self._to_go.shape):
            raise UserError(f"rewards have shape {np.shape(rewards)}, expected {self._to_go.shape} or a number")

    def _draw(self, logits: Tensor) -> np.ndarray:
        """(n, A) to (n,) int64."""
        warm = (logits - logits.amax(-1, keepdim=True)) / self._temperature
        below = warm.softmax(-1).cumsum(-1).numpy()
        numbers = np.array([random.random() for random in self._random])
        drawn = (below[:, :-1] <= numbers[:, None]).sum(1)
        return drawn.astype(np.int64)
