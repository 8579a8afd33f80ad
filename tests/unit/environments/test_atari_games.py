"""Games and actions by name, scores relative to a gamer's, and what is said where a game or ale-py is missing."""

from __future__ import annotations

import sys

import pytest

from repdib_lightning.environments.atari_games import SCORES, action_meanings, game_name, gamer_normalised
from repdib_lightning.errors import UserError

pytest.importorskip("ale_py")
pytest.importorskip("cv2")


@pytest.mark.parametrize("written", ["ms_pacman", "MsPacman", "MSPACMAN", "ms-pacman", "Ms Pacman"])
def test_a_game_may_be_spelt_in_any_usual_way(written):
    assert game_name(written) == "ms_pacman"


def test_every_game_of_ale_is_known_by_its_own_name():
    from ale_py import roms

    known = roms.get_all_rom_ids()
    assert [game_name(name) for name in known] == known and len(known) > 100


@pytest.mark.parametrize(
    ("written", "meant"), [("Breakot", "breakout"), ("MsPacmn", "ms_pacman"), ("seaqest", "seaquest")]
)
def test_an_unknown_game_names_the_nearest(written, meant):
    with pytest.raises(UserError, match=rf"^game={written}: unknown, did you mean '{meant}'\? \(choices: "):
        game_name(written)


def test_actions_are_the_minimal_set_in_ales_order():
    assert action_meanings("Breakout") == ["NOOP", "FIRE", "RIGHT", "LEFT"]
    assert [len(action_meanings(game)) for game in ("pong", "seaquest", "qbert")] == [6, 18, 6]
    action_meanings("pong").clear()
    assert action_meanings("pong")[:2] == ["NOOP", "FIRE"]


def test_the_random_player_scores_0_and_the_gamer_100():
    assert set(SCORES) == {"breakout", "pong", "qbert", "seaquest"}
    for game, (random, gamer) in SCORES.items():
        assert (gamer_normalised(game, random), gamer_normalised(game, gamer)) == (0.0, 100.0)
    assert gamer_normalised("Pong", -3.0) == 50.0 and gamer_normalised("breakout", 58.0) == 200.0
    assert gamer_normalised("tennis", 1.0) is None


@pytest.mark.parametrize("missing", ["ale_py", "cv2"])
def test_what_is_not_installed_is_named_with_its_extra(missing, monkeypatch):
    monkeypatch.setitem(sys.modules, missing, None)
    with pytest.raises(UserError) as told:
        game_name("breakout")
    assert str(told.value) == "Atari games need ale-py and opencv: pip install 'repdib_lightning[atari]'"
