"""What all scripted policies of Atari games share: they read the console's memory, and act at random at times."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import ClassVar

import numpy as np

from repdib_lightning.environments.atari_games import action_meanings
from repdib_lightning.environments.atari_ram import VARIABLES


class Script(ABC):
    """A policy for one game that knows where everything is, but for a share of random actions.

    Args:
        epsilon: share of actions that are drawn at random, in [0, 1].
    """

    game: ClassVar[str]

    def __init__(self, epsilon: float) -> None:
        self.epsilon = epsilon
        self._meanings = action_meanings(self.game)
        self._addresses = {name: found.addresses for name, found in VARIABLES[self.game].items()}
        self.reset()

    def reset(self) -> None:
        """Forget the game before."""
        self._before: dict[str, int] = {}
        self._taken = ["NOOP"] * 2

    def act(self, ram: np.ndarray, random: np.random.Generator) -> int:
        """Choose an action: (128,) uint8 -> its number."""
        now = {name: int(ram[addresses[0]]) for name, addresses in self._addresses.items()}
        chosen = self._meanings.index(self._choose(now, ram, random))
        self._before = now
        if random.random() < self.epsilon:
            chosen = int(random.integers(len(self._meanings)))
        self._taken = [*self._taken[1:], self._meanings[chosen]]
        return chosen

    @abstractmethod
    def _choose(self, now: dict[str, int], ram: np.ndarray, random: np.random.Generator) -> str:
        """The action's meaning, from the variables of the moment (the first byte of each) and all of the memory."""

    def _all(self, name: str, ram: np.ndarray) -> list[int]:
        """All bytes of a variable."""
        return [int(ram[address]) for address in self._addresses[name]]

    def _change(self, name: str, now: dict[str, int]) -> int:
        return now[name] - self._before.get(name, now[name])
