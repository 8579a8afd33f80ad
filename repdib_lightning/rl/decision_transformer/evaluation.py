"""Episodes in which a Decision Transformer is asked for a return, what is asked for, and how the scores are told."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import gymnasium
import numpy as np

from repdib_lightning.records import DataSpec
from repdib_lightning.rl.decision_transformer.options import TARGETS
from repdib_lightning.rl.decision_transformer.play import Play
from repdib_lightning.rl.episodes_at_once import EpisodesAtOnce
from repdib_lightning.rl.offline_environment import ATARI

FILMED_STEPS = 1000
"""Of an episode, at most: a film is made in memory, and episodes of Atari may have 27,000 steps."""


class ConditionedEpisodes(EpisodesAtOnce):
    """One episode in each of several copies of an environment with discrete actions, the same ones every time.

    Each copy is reset once. Args: as :class:`~repdib_lightning.rl.episodes_at_once.EpisodesAtOnce`.
    """

    def __init__(self, environments: Sequence[gymnasium.Env[Any, Any]], spec: DataSpec, seed: int) -> None:
        super().__init__(environments, spec, seed)
        self.count = len(environments)

    def play(self, begin: Callable[[int, int], Play], film: int = 0) -> tuple[np.ndarray, list[np.ndarray]]:
        """Play until every episode has ended.

        Args:
            begin: given the number of episodes and a seed, what acts in them. film: how many of them to film.

        Returns:
            returns (n,), undiscounted; and of each filmed episode the pictures that the agent saw in its first
            :data:`FILMED_STEPS` steps, (T, H, W, 3) uint8.
        """
        seen = self._reset()
        play = begin(self.count, self._seed)
        returns, playing = np.zeros(self.count), np.arange(self.count)
        films: list[list[np.ndarray]] = [[] for _ in range(film)]
        rewards: np.ndarray | None = None
        while len(playing):
            for place in playing[playing < film]:
                if len(films[place]) < FILMED_STEPS:
                    films[place].append(self._newest(seen[place]))
            shown = {name: np.stack([seen[i][name] for i in playing]) for name in self._spec.observations}
            actions = play.act(shown, rewards)
            rewards, going = np.zeros(len(playing)), np.ones(len(playing), bool)
            for number, (i, action) in enumerate(zip(playing, actions, strict=True)):
                environment = self._environments[i]
                space: Any = environment.action_space
                seen[i], reward, terminated, truncated, _ = environment.step(int(action) + int(space.start))
                rewards[number], going[number] = float(reward), not (terminated or truncated)
            returns[playing] += rewards
            if not going.all():
                kept = np.flatnonzero(going)
                playing, rewards = playing[kept], rewards[kept]
                play.keep(kept)
        return returns, [np.stack(frames) for frames in films]


def game_of(evaluated_in: tuple[str, Mapping[str, Any]] | None) -> str:
    """Name of the Atari game of an environment and its options; empty for any other environment."""
    if evaluated_in is None or evaluated_in[0] not in (ATARI, "Atari"):
        return ""
    from repdib_lightning.environments.atari_games import game_name

    return game_name(str(evaluated_in[1].get("game", "breakout")))


def asked_return(given: float | None, game: str, best: float) -> float:
    """The target return: the given one, else the published one of the game, else the best of the data."""
    return TARGETS.get(game, best) if given is None else given


def scores(returns: np.ndarray, game: str) -> dict[str, float]:
    """Mean and deviation over episodes (n,); and in percent of a gamer, where the game's scores are known."""
    reached = float(returns.mean())
    measures = {"return": reached, "return_deviation": float(returns.std())}
    if game:
        from repdib_lightning.environments.atari_games import gamer_normalised

        normalised = gamer_normalised(game, reached)
        if normalised is not None:
            measures["normalised"] = normalised
    return measures
