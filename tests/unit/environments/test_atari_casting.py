"""Who plays which game: shares of samples, whatever the lengths, and the same games however they were played."""

from __future__ import annotations

from itertools import islice

import numpy as np
import pytest

from repdib_lightning.environments.atari_casting import Casting

RATES = (0.1, 0.4, 0.3, 0.2)
MEANS = (180, 700, 1500, 3000)


def length(number: int) -> int:
    who = number % len(RATES)
    return int(np.random.default_rng(number).integers(MEANS[who] // 3, 2 * MEANS[who]))


def cast(samples: int, ahead: int, seed: int = 0) -> tuple[Casting, list[int]]:
    """Play as workers would: up to ``ahead`` games are under way, finished ones are told of in the order given."""
    casting, under_way, played = Casting(RATES, samples), [], []
    place = 0
    while not casting.complete:
        while len(under_way) < ahead:
            under_way.append(casting[place])
            place += 1
        number = under_way.pop(0)
        played.append(number)
        casting.played(number, length(number))
    return casting, played


@pytest.mark.parametrize("samples", [1, 3_000, 100_000])
def test_which_games_are_kept_does_not_depend_on_how_many_are_played_at_once(samples):
    casts = [cast(samples, ahead) for ahead in (1, 2, 4, 9)]
    for casting, played in casts:
        assert casting.kept == casts[0][0].kept and set(casting.kept) <= set(played)
        assert len(set(played)) == len(played)


def test_everybody_plays_his_share_all_along_the_recording():
    casting, played = cast(200_000, 4)
    lengths = np.array([length(number) for number in casting.kept])
    players = np.array(casting.kept) % len(RATES)
    for part in np.array_split(np.arange(len(lengths)), 4):
        shares = np.bincount(players[part], lengths[part], len(RATES)) / lengths[part].sum()
        assert np.abs(shares - RATES).max() < 0.1
    shares = np.bincount(players, lengths) / lengths.sum()
    assert np.abs(shares - RATES).max() < 0.02
    wasted = sum(map(length, played)) - lengths.sum()
    assert wasted < 0.15 * lengths.sum()


def test_a_players_games_are_his_first_ones_and_the_last_one_reaches_the_samples():
    for samples in (1, 5_000, 40_000):
        casting, _ = cast(samples, 3)
        for who in range(len(RATES)):
            turns = [number // len(RATES) for number in casting.kept if number % len(RATES) == who]
            assert turns == list(range(len(turns)))
        lengths = [length(number) for number in casting.kept]
        assert sum(lengths) == casting.total and casting.total - lengths[-1] < samples <= casting.total


def test_the_games_to_play_are_decided_once():
    casting = Casting(RATES, 10_000)
    first = list(islice(casting, 6))
    for number in first:
        casting.played(number, length(number))
    assert list(islice(casting, 6)) == first and len(casting) > 10**9
