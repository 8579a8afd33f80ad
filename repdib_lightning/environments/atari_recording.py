"""Recordings of Atari: games are played first, without pictures, then played again from their actions and filmed."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import numpy as np

from repdib_lightning.data.schema import FactorSpec
from repdib_lightning.environments.atari_game import AtariGame
from repdib_lightning.environments.atari_players import Player, player
from repdib_lightning.environments.atari_ram import ram_factor_specs, ram_factors
from repdib_lightning.environments.control_background import RECORDED_HELD_OUT
from repdib_lightning.environments.episode_workers import evaluation_episodes
from repdib_lightning.environments.side_image import Side, SideImage

VIEW = "frame"
"""Name of the observation."""

NOOP_MAX = 30
EVALUATION_SHARE = 0.1

_NOOPS, _STICKING, _PLAYER, _IMAGE = range(4)
"""Streams of chance of a game."""


@dataclass(frozen=True)
class AtariRecording:
    """What a recording is made of, as ``collect_atari`` names it; together it decides every byte.

    Attributes:
        policy_digest: of the file of networks; empty where none plays.
    """

    game: str
    samples: int
    mixture: dict[str, float]
    sticky: float
    frame_skip: int
    image_size: int
    max_frames: int
    side: Side
    side_width: int
    side_source: str
    seed: int
    policy: str = ""
    policy_digest: str = ""

    def console(self) -> AtariGame:
        """The game, ready to be played."""
        return AtariGame(
            self.game,
            image_size=self.image_size,
            frame_skip=self.frame_skip,
            sticky=self.sticky,
            noop_max=NOOP_MAX,
            max_frames=self.max_frames,
        )

    def side_image(self) -> SideImage:
        """What is seen beside it."""
        return SideImage(self.side, self.side_width, self.side_source, self.seed, self.image_size)

    @cached_property
    def players(self) -> list[str]:
        """Names of those who play."""
        return list(self.mixture)

    def who(self, number: int) -> str:
        """Name of the player of a game; see :class:`~repdib_lightning.environments.atari_casting.Casting`."""
        return self.players[number % len(self.players)]

    def chance(self, number: int, stream: int) -> np.random.Generator:
        """One of the streams of chance of a game, whatever the others are used for."""
        turn, who = divmod(number, len(self.players))
        return np.random.default_rng([self.seed, who, turn, stream])

    def configuration(self) -> dict[str, Any]:
        """All of it as plain values: arguments of ``AtariEnv``, and what else is needed to make it again."""
        return {**asdict(self), "policy": Path(self.policy).name, "noop_max": NOOP_MAX}

    def open(self) -> Callable[[int], dict[str, Any]]:
        """Open the game in this process: a function that plays a game without pictures."""
        opened = None
        if self.policy:
            import torch

            from repdib_lightning.environments.atari_network import read_atari_policy

            torch.set_num_threads(1)
            size = {"frame_skip": self.frame_skip, "image_size": self.image_size}
            opened = read_atari_policy(Path(self.policy), game=self.game, **size)
        players = {name: player(name, self.game, opened) for name in self.players}
        return partial(play, self, game=self.console(), players=players)


def play(recording: AtariRecording, number: int, game: AtariGame, players: dict[str, Player]) -> dict[str, Any]:
    """Play one game: ``actions`` (T,) uint8 and ``rewards`` (T,) float32."""
    who, random = players[recording.who(number)], recording.chance(number, _PLAYER)
    game.reset(recording.chance(number, _NOOPS), recording.chance(number, _STICKING))
    who.begin()
    actions: list[int] = []
    rewards: list[float] = []
    while not (game.over or game.truncated):
        actions.append(who.act(game, random))
        rewards.append(game.step(actions[-1]))
    return {"actions": np.array(actions, np.uint8), "rewards": np.array(rewards, np.float32)}


@dataclass(frozen=True)
class PlayedGame:
    """A game that is to be filmed. Attributes: ``number``; ``actions`` (T,) uint8; ``rewards`` (T,) float32."""

    number: int
    actions: np.ndarray
    rewards: np.ndarray


@dataclass(frozen=True)
class AtariFilm:
    """What is filmed. Attributes: ``recording``; ``games``, one an episode."""

    recording: AtariRecording
    games: Sequence[PlayedGame]

    @property
    def rows(self) -> int:
        """N, final observations included."""
        return sum(len(game.actions) + 1 for game in self.games)

    @cached_property
    def evaluation_episodes(self) -> set[int]:
        """Which episodes are never trained on: a tenth of them, spread evenly over the players and their games."""
        by_player = sorted(range(len(self.games)), key=lambda i: self.recording.who(self.games[i].number))
        return {by_player[place] for place in evaluation_episodes(len(self.games), EVALUATION_SHARE)}

    def factor_specs(self) -> dict[str, FactorSpec]:
        """What is known of each ground-truth factor."""
        return {**ram_factor_specs(self.recording.game), **self.recording.side_image().factor_specs()}

    def open(self) -> Callable[[int], dict[str, Any]]:
        """Open the game in this process: a function that films an episode."""
        return partial(film, self, game=self.recording.console(), side=self.recording.side_image())


def film(films: AtariFilm, episode: int, game: AtariGame, side: SideImage) -> dict[str, Any]:
    """Play one game again and film it: the arguments of :meth:`EpisodeWriter.add_episode`."""
    recording, played = films.recording, films.games[episode]
    evaluation, rows = episode in films.evaluation_episodes, len(played.actions) + 1
    drawing = recording.chance(played.number, _IMAGE)
    image = side.draw(drawing, evaluation, RECORDED_HELD_OUT if evaluation else None)
    frames = np.empty((rows, 1, *side.shape), np.uint8)
    memory = np.empty((rows, 128), np.uint8)
    rewards = np.full(rows - 1, np.nan, np.float32)
    game.reset(recording.chance(played.number, _NOOPS), recording.chance(played.number, _STICKING))
    for row in range(rows):
        frames[row, 0], memory[row] = side.beside(game.picture(), image), game.ram()
        if row < rows - 1 and not (game.over or game.truncated):
            rewards[row] = game.step(int(played.actions[row]))
    same = (game.over or game.truncated) and np.array_equal(rewards, played.rewards)
    assert same, f"game {played.number} of {recording.game} went another way when it was played again"
    ended = np.arange(rows - 1) == rows - 2
    beside = {name: np.broadcast_to(value, (rows, *value.shape)) for name, value in side.factors(image).items()}
    return {
        "observations": {VIEW: frames},
        "factors": {**ram_factors(recording.game, memory), **beside},
        "actions": played.actions.astype(np.int64),
        "rewards": rewards,
        "terminations": ended & game.over,
        "truncations": ended & game.truncated,
        "evaluation": evaluation,
    }
