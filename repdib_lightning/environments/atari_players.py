"""Who plays a recording of Atari: the players that a mixture names, and what is wrong with a mixture."""

from __future__ import annotations

import math
import re
from collections import deque
from collections.abc import Mapping
from typing import TYPE_CHECKING, Protocol

import numpy as np

from repdib_lightning.environments.atari_game import AtariGame
from repdib_lightning.environments.atari_policies import SCRIPTS
from repdib_lightning.environments.atari_script import Script
from repdib_lightning.errors import UserError, nearest

if TYPE_CHECKING:  # torch is loaded only where a network plays
    from repdib_lightning.environments.atari_network import AtariPolicyFile, NatureNetwork

NETWORK_EPSILON = 0.05
"""Share of a network's actions that are drawn at random; as in Mnih et al. (2015)."""

SCRIPTED_MIXTURE = {"random": 0.1, "scripted-0.3": 0.2, "scripted-0.1": 0.3, "scripted-0.02": 0.4}
"""Who plays which share of the samples of a game that has a script, where nothing else is said."""

_KINDS = ("random", "scripted-EPSILON", "dqn", "dqn-STEPS")
_SCRIPTED = re.compile(r"scripted-(\d+(?:\.\d*)?|\.\d+)")
_NETWORK = re.compile(r"dqn(?:-(\d+))?")


class Player(Protocol):
    """Somebody who plays games, one after the other."""

    def begin(self) -> None:
        """Forget the game before."""
        ...

    def act(self, game: AtariGame, random: np.random.Generator) -> int:
        """Number of the next action; chance comes from the generator alone."""
        ...


class RandomPlayer:
    """Draws every action."""

    def begin(self) -> None:
        """There is nothing to forget."""

    def act(self, game: AtariGame, random: np.random.Generator) -> int:
        """Any action, all alike."""
        return int(random.integers(game.actions))


class ScriptedPlayer:
    """Plays by a script."""

    def __init__(self, script: Script) -> None:
        self._script = script

    def begin(self) -> None:
        """Forget the game before."""
        self._script.reset()

    def act(self, game: AtariGame, random: np.random.Generator) -> int:
        """What the script says."""
        return self._script.act(game.ram(), random)


class NetworkPlayer:
    """Sees the game's own pictures, without an image beside them, and takes the best action but for a small share."""

    def __init__(self, network: NatureNetwork, stack: int) -> None:
        self._network = network
        self._frames: deque[np.ndarray] = deque(maxlen=stack)

    def begin(self) -> None:
        """Forget the game before."""
        self._frames.clear()

    def act(self, game: AtariGame, random: np.random.Generator) -> int:
        """The action of the highest value."""
        frame = game.picture()
        self._frames.extend([frame] * (1 if self._frames else self._frames.maxlen or 1))
        best = self._network.best(np.stack(self._frames))
        return int(random.integers(game.actions)) if random.random() < NETWORK_EPSILON else best


def default_mixture(game: str, policy: AtariPolicyFile | None) -> dict[str, float]:
    """Who plays where nothing is said: networks of all ages if there are any, else the script, else chance alone."""
    if policy is not None:
        return {"random": 0.1, **{name: 0.9 / len(policy.names) for name in policy.names}}
    return dict(SCRIPTED_MIXTURE) if game in SCRIPTS else {"random": 1.0}


def check_mixture(mixture: Mapping[str, float], game: str, policy: AtariPolicyFile | None) -> None:
    """Check that all who are named can play, and that their rates are shares.

    Raises:
        UserError: naming who cannot play and who could, or the sum of the rates.
    """
    for name, rate in mixture.items():
        if not (math.isfinite(rate) and rate > 0):
            raise UserError(f"mixture: rate of {name} is {rate}, must be above 0; leave out who does not play")
        _check_name(name, game, policy)
    total = sum(mixture.values())
    if abs(total - 1.0) > 1e-6:
        raise UserError(f"mixture: the rates sum to {total:g}, must sum to 1")
    if policy is not None and not any(_NETWORK.fullmatch(name) for name in mixture):
        raise UserError(f"--policy {policy.path}: nobody of the mixture plays it; name dqn or {policy.names[-1]}")


def _check_name(name: str, game: str, policy: AtariPolicyFile | None) -> None:
    if name == "random":
        return
    if scripted := _SCRIPTED.fullmatch(name):
        if game not in SCRIPTS:
            raise UserError(f"mixture: {name}: no script plays {game}; scripts play {', '.join(sorted(SCRIPTS))}")
        if float(scripted[1]) > 1:
            raise UserError(f"mixture: {name}: the share of random actions must be from 0 to 1")
    elif network := _NETWORK.fullmatch(name):
        if policy is None:
            raise UserError(f"mixture: {name} needs --policy, a file of 'collect atari_policy'")
        if network[1]:
            policy.network(int(network[1]))
    else:
        raise UserError(f"mixture: unknown player '{name}', {nearest(name, _KINDS)}")


def player(name: str, game: str, policy: AtariPolicyFile | None) -> Player:
    """The player of a checked name."""
    if name == "random":
        return RandomPlayer()
    if scripted := _SCRIPTED.fullmatch(name):
        return ScriptedPlayer(SCRIPTS[game](float(scripted[1])))
    network = _NETWORK.fullmatch(name)
    assert network is not None and policy is not None
    age = int(network[1]) if network[1] else None
    return NetworkPlayer(policy.network(age), policy.facts["stack"])
