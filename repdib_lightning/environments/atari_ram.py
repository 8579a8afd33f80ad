"""What an Atari console remembers of a game: variables at known addresses of its 128 bytes, as factors.

Names and most addresses are those of AtariARI (Anand et al. 2019, "Unsupervised State Representation Learning in
Atari"). Each one that is listed here was checked by playing some thousand steps and comparing with the screen: see the
comments. Positions are in the console's own units, a pixel each, from an edge that differs between variables.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from repdib_lightning.data.schema import FactorSpec


@dataclass(frozen=True)
class Variable:
    """Where a variable is, and how its bytes are read.

    Attributes:
        addresses: of its bytes.
        read: ``each`` byte is a value; the number of set ``bits`` of all is the value; or all are one ``decimal``
            number of two digits a byte, the first ones first.
    """

    addresses: tuple[int, ...]
    read: Literal["each", "bits", "decimal"] = "each"

    @property
    def width(self) -> int:
        """How many values it has."""
        return len(self.addresses) if self.read == "each" else 1

    def of(self, ram: np.ndarray) -> np.ndarray:
        """(..., 128) uint8 to (...) float32, or (..., width) where there are several values."""
        values = ram[..., self.addresses]
        if self.read == "bits":
            return np.unpackbits(values, axis=-1).sum(-1).astype(np.float32)
        if self.read == "decimal":
            digits = 10 * (values >> 4).astype(np.float32) + (values & 15)
            return np.asarray(digits @ 100.0 ** np.arange(len(self.addresses))[::-1], np.float32)
        return np.asarray(values[..., 0] if self.width == 1 else values, np.float32)


_ONE_BYTE = {
    # Centre of the blob of the object's colour = value + a constant; largest deviation in brackets, in pixels. What is
    # not on the field has the value 0.
    "pong": {
        "player_y": 51,  # (0.9)
        "enemy_y": 50,  # (0)
        "ball_x": 49,  # (0)
        "ball_y": 54,  # (1.3)
        "player_score": 14,  # its rises, less the enemy's, are the rewards
        "enemy_score": 13,
    },
    "breakout": {
        "player_x": 72,  # (0)
        "ball_x": 99,  # (0)
        "ball_y": 101,  # (0)
        "lives": 57,  # equal to ALE's
    },
    "seaquest": {
        "player_x": 70,  # the left edge of the submarine (1)
        "player_y": 97,  # (0.7)
        "player_direction": 86,  # 0 right, 8 left: where the heavier end of the submarine is
        "missile_x": 103,  # the left edge of the player's torpedo (1, or 4 where it leaves the screen); 0 for none
        "oxygen": 102,  # length of the bar in pixels / 5 (3.1)
        "divers": 62,  # divers on board: as many are drawn below the bar
        "lives": 59,  # lives left behind the one that is played: ALE's less 1
    },
    "qbert": {
        "player_x": 43,  # (6, while it hops or falls)
        "player_y": 67,  # (1 where it stands)
    },
}

VARIABLES: dict[str, dict[str, Variable]] = {
    game: {name: Variable((address,)) for name, address in found.items()} for game, found in _ONE_BYTE.items()
}
"""Game -> name -> variable."""

VARIABLES["breakout"] |= {
    "bricks": Variable(tuple(range(36)), "bits"),  # correlation with the pixels of the wall: 0.99999
    "score": Variable((76, 77), "decimal"),  # the sum of rewards
}
VARIABLES["seaquest"] |= {
    "enemy_x": Variable((30, 31, 32, 33)),  # of each lane from the bottom up; left edge of its fish, or less 32
    "diver_x": Variable((71, 72, 73, 74)),  # of each lane from the bottom up (0.5)
    "score": Variable((57, 58), "decimal"),  # the sum of rewards
}
VARIABLES["qbert"] |= {
    # Colour of each cube's top, row by row from the top: 26 exactly where it is drawn in the first level's other one.
    "cubes": Variable((21, 52, 54, 83, 85, 87, 98, 100, 102, 104, 1, 3, 5, 7, 9, 32, 34, 36, 38, 40, 42)),
    "score": Variable((89, 90, 91), "decimal"),  # the sum of rewards
}


def ram_factors(game: str, ram: np.ndarray) -> dict[str, np.ndarray]:
    """The variables of a game by name; empty for games without a table.

    Args:
        game: as ALE names it.
        ram: (..., 128) uint8.

    Returns:
        Name -> (...) float32, or (..., width) where a variable has several values.
    """
    return {name: variable.of(ram) for name, variable in VARIABLES.get(game, {}).items()}


def ram_factor_specs(game: str) -> dict[str, FactorSpec]:
    """What is known of the variables of a game: all are endogenous and continuous; none for games without a table."""
    return {
        name: FactorSpec("endogenous", "continuous", width=variable.width)
        for name, variable in VARIABLES.get(game, {}).items()
    }
