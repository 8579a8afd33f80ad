"""Plays on without reading anew what was read: keys and values of the tokens so far, for several episodes at once."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from torch import Tensor

if TYPE_CHECKING:
    from repdib_lightning.rl.decision_transformer.network import DecisionTransformer


class LayerCache:
    """Keys and values of one layer.

    Args:
        episodes: n. heads, width: of the layer, width per head. capacity: most tokens. device: where.

    Attributes:
        length: tokens so far.
    """

    def __init__(self, episodes: int, heads: int, capacity: int, width: int, device: torch.device) -> None:
        self._keys = torch.zeros(episodes, heads, capacity, width, device=device)
        self._values = torch.zeros_like(self._keys)
        self.length = 0

    def extend(self, keys: Tensor, values: Tensor) -> tuple[Tensor, Tensor]:
        """Add those of the newest tokens, (n, heads, m, width); returns those of all, (n, heads, length, width)."""
        new = slice(self.length, self.length + keys.shape[2])
        self._keys[:, :, new], self._values[:, :, new] = keys, values
        self.length = new.stop
        return self._keys[:, :, : new.stop], self._values[:, :, : new.stop]

    def keep(self, places: Tensor) -> None:
        """Go on with some of the episodes, (m,) int64."""
        self._keys, self._values = self._keys[places], self._values[places]


class CachedContext:
    """The window of a network in several episodes that are played in step; each step costs two or three tokens.

    What it returns is what the network gives for the whole window, up to rounding. Positions are absolute, so a window
    cannot slide without being read anew. When it is full, its newer half (``context // 2`` steps) is read again as a
    window of its own, and grows from there. The published program reads a full window in every step.

    Args:
        network: in evaluation mode. episodes: n.

    Attributes:
        first: time step at which the window begins. steps: of the window.
    """

    def __init__(self, network: DecisionTransformer, episodes: int) -> None:
        self._network, sizes = network, network.sizes
        self._device = network.positions.device
        # Of each step: return-to-go, state, action, embedded.
        self._tokens = torch.zeros(episodes, sizes.context, 3, sizes.width, device=self._device)
        self.first = self.steps = 0
        self._caches = self._empty(episodes)

    def _empty(self, episodes: int) -> list[LayerCache]:
        sizes = self._network.sizes
        per_head = sizes.width // sizes.heads
        shape = (episodes, sizes.heads, 3 * sizes.context, per_head)
        return [LayerCache(*shape, self._device) for _ in range(sizes.layers)]

    def step(self, states: Tensor, returns: Tensor, actions: Tensor | None) -> Tensor:
        """Read what is seen now.

        Args:
            states: (n, ...). returns: (n,), to go. actions: (n,) int64, those of the step before; None in the first.

        Returns:
            logits (n, A) of the actions to take.
        """
        network, context = self._network, self._network.sizes.context
        if actions is not None:
            self._tokens[:, self.steps - 1, 2] = network.embed_actions(actions)
        if self.steps == context:
            self._begin_anew(context // 2)
        self._tokens[:, self.steps, 0] = network.embed_returns(returns)
        self._tokens[:, self.steps, 1] = network.states(states.unsqueeze(1))[:, 0]
        self.steps += 1
        unread = self._tokens.flatten(1, 2)[:, self._caches[0].length : 3 * self.steps - 1]
        began = torch.full((len(unread),), self.first, device=self._device)
        return network.read(unread, began, slice(-1, None), self._caches)[:, 0]

    def _begin_anew(self, kept: int) -> None:
        self._tokens = torch.cat([self._tokens[:, self.steps - kept :], self._tokens[:, : self.steps - kept]], dim=1)
        self.first, self.steps = self.first + self.steps - kept, kept
        for cache in self._caches:
            cache.length = 0

    def keep(self, places: Tensor) -> None:
        """Go on with some of the episodes, (m,) int64."""
        self._tokens = self._tokens[places]
        for cache in self._caches:
            cache.keep(places)
