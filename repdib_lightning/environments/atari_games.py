"""The games of the Arcade Learning Environment: their names, actions, and what scores are measured against."""

from __future__ import annotations

import re
from functools import lru_cache
from importlib import import_module
from typing import Any

from repdib_lightning.errors import UserError, nearest

SCORES: dict[str, tuple[float, float]] = {
    "breakout": (2.0, 30.0),
    "pong": (-21.0, 15.0),
    "qbert": (164.0, 13455.0),
    "seaquest": (68.0, 42055.0),
}
"""Game -> score of a random player and of a gamer, as rounded by the Decision Transformer (Chen et al. 2021)."""


def arcade() -> Any:
    """The ``ale_py`` module.

    Raises:
        UserError: it or OpenCV, which scales its pictures, is not installed.
    """
    try:
        import ale_py
        import cv2  # noqa: F401
    except ImportError as error:
        raise UserError("Atari games need ale-py and opencv: pip install 'repdib_lightning[atari]'") from error
    return ale_py


def game_name(game: str) -> str:
    """A game as ALE names it: ``Breakout``, ``MsPacman`` and ``ms-pacman`` are ``breakout`` and ``ms_pacman``.

    Raises:
        UserError: ALE has no such game (names the nearest), or is not installed.
    """
    arcade()
    known = {_letters(name): name for name in import_module("ale_py.roms").get_all_rom_ids()}
    if _letters(game) not in known:
        raise UserError(f"game={game}: unknown, {nearest(_spelt(game), known.values())}")
    return known[_letters(game)]


def _letters(game: str) -> str:
    return re.sub(r"[^a-z0-9]", "", game.lower())


def _spelt(game: str) -> str:
    """MsPacmn -> ms_pacmn, so that the nearest name is searched among like spellings."""
    return re.sub(r"(?<=[a-z0-9])(?=[A-Z])", "_", game).lower()


def action_meanings(game: str) -> list[str]:
    """Names of the actions that mean something in a game, such as ``NOOP`` and ``FIRE``, in ALE's order.

    Raises:
        UserError: see :func:`game_name`.
    """
    return list(_meanings(game_name(game)))


@lru_cache
def _meanings(game: str) -> tuple[str, ...]:
    return tuple(action.name for action in loaded(game).getMinimalActionSet())


def loaded(game: str, **settings: int | float) -> Any:
    """An ``ALEInterface`` with the game's cartridge in it.

    Args:
        game: as ALE names it.
        settings: ALE's own, such as ``repeat_action_probability``; they hold from when the cartridge is put in.
    """
    ale_py = arcade()
    ale_py.ALEInterface.setLoggerMode(ale_py.LoggerMode.Error)  # before it is made, or it greets
    console = ale_py.ALEInterface()
    for name, value in settings.items():
        (console.setInt if isinstance(value, int) else console.setFloat)(name, value)
    console.loadROM(import_module("ale_py.roms").get_rom_path(game))
    return console


def gamer_normalised(game: str, score: float) -> float | None:
    """A score where the random player has 0 and the gamer 100; None for games that :data:`SCORES` lacks."""
    known = {_letters(name): scores for name, scores in SCORES.items()}.get(_letters(game))
    return None if known is None else 100.0 * (score - known[0]) / (known[1] - known[0])
