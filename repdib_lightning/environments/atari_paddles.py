"""Scripted policies of games with a paddle: Pong and Breakout. Places are the console's, in pixels."""

from __future__ import annotations

from itertools import product
from typing import ClassVar

import numpy as np

from repdib_lightning.environments.atari_script import Script


def bounced(place: float, low: float, high: float) -> float:
    """Where something that would be at ``place`` is, if walls at ``low`` and ``high`` throw it back."""
    span = high - low
    way = (place - low) % (2 * span)
    return low + (way if way <= span else 2 * span - way)


class PaddleScript(Script):
    """Steers a paddle that has inertia: the best of all plans of three moves, of which the first is made."""

    _MOVES: ClassVar[dict[str, int]]
    """Meaning of an action -> where it moves the paddle; those that are chosen stand last."""
    _RESPONSE: ClassVar[tuple[float, float, float]]
    """How far an action moves the paddle in its own step and in the next two."""
    _PLANS = np.array(list(product((0, -1, 1), repeat=3)))
    _EFFORT = 0.6
    """What a move costs, in pixels missed, so that the paddle rests where it can."""

    def _steer(self, place: float, wanted: float, steps: float) -> str:
        """The move after which the paddle, now at ``place``, is where it is wanted in so many steps."""
        missed = np.abs(self._reached(place, steps) - wanted) + self._EFFORT * np.abs(self._PLANS).sum(1)
        return {move: name for name, move in self._MOVES.items()}[int(self._PLANS[np.argmin(missed), 0])]

    def _reached(self, place: float, steps: float) -> np.ndarray:
        """(27,) where the paddle will be under each plan."""
        taken = [self._MOVES.get(meaning, 0) for meaning in self._taken]
        moves = np.pad(self._PLANS, ((0, 0), (2, 2)))
        moves[:, :2] = taken
        first, second, third = self._RESPONSE
        speeds = first * moves[:, 2:] + second * moves[:, 1:-1] + third * moves[:, :-2]  # (27, 5)
        places = place + np.pad(np.cumsum(speeds, axis=1), ((0, 0), (1, 0)))
        if steps > 3:
            return np.asarray(places[:, 5])
        whole = int(steps)
        return np.asarray(places[:, whole] + (steps - whole) * (places[:, whole + 1] - places[:, whole]))


class PongScript(PaddleScript):
    """Foresees where the ball will be and steers the paddle so that its upper end hits.

    Such balls fly off steeply, and the enemy is too slow for many of them.
    """

    game = "pong"

    _MOVES: ClassVar[dict[str, int]] = {"LEFTFIRE": 1, "RIGHTFIRE": -1, "LEFT": 1, "RIGHT": -1, "NOOP": 0}
    _RESPONSE = (10.0, 9.0, 2.0)
    _HIT_AT, _GONE_AT = 189, 192
    """Ball's place where the paddle is."""
    _TOP, _BOTTOM = 46, 205
    """Ball's places at the walls."""
    _LEVEL = 6.3
    """Ball's place less the paddle's where their centres are level."""
    _AIM, _SPREAD = 6.0, 1.0
    """How far above the paddle's centre the ball is to hit; drawn anew for each ball, or it could fly in circles."""
    _HOME = 110
    _REACH = (40, 200)

    def reset(self) -> None:
        """Forget the game before."""
        super().reset()
        self._aim = self._AIM

    def _choose(self, now: dict[str, int], ram: np.ndarray, random: np.random.Generator) -> str:
        if now["ball_x"] < 90:
            self._aim = self._AIM + random.uniform(-self._SPREAD, self._SPREAD)
        speed = self._change("ball_x", now)
        if not (self._before.get("ball_x") and now["ball_x"] and speed > 0 and now["ball_x"] < self._GONE_AT):
            return self._steer(now["player_y"], self._HOME, 3.0)
        steps = max((self._HIT_AT - now["ball_x"]) / speed, 0.5)
        place = bounced(now["ball_y"] + self._change("ball_y", now) * steps, self._TOP, self._BOTTOM)
        return self._steer(now["player_y"], np.clip(place - self._LEVEL + self._aim, *self._REACH), steps)


class BreakoutScript(PaddleScript):
    """Foresees where the ball comes down, and is there; serves with FIRE."""

    game = "breakout"

    _MOVES: ClassVar[dict[str, int]] = {"RIGHT": 1, "LEFT": -1, "NOOP": 0}
    _RESPONSE = (12.0, 10.5, 0.0)
    _LEFT, _RIGHT = 57, 199
    """Ball's places at the walls."""
    _HIT_AT, _GONE_AT = 178, 190
    """Ball's place where the paddle is."""
    _LEVEL = 9
    """Ball's place less the paddle's where their centres are level."""
    _SPREAD = 4.0
    """How far from its middle the paddle hits; drawn anew for each ball, or it could fly in circles."""
    _REACH = (55, 191)

    def reset(self) -> None:
        """Forget the game before."""
        super().reset()
        self._aim = 0.0

    def _choose(self, now: dict[str, int], ram: np.ndarray, random: np.random.Generator) -> str:
        if not now["ball_y"]:
            return "FIRE"
        place, steps = float(now["ball_x"]), 3.0
        fall = self._change("ball_y", now)
        if fall <= 0:
            self._aim = random.uniform(-self._SPREAD, self._SPREAD)
        elif self._before["ball_y"] and now["ball_y"] < self._GONE_AT:
            steps = max((self._HIT_AT - now["ball_y"]) / fall, 0.5)
            place = bounced(place + self._change("ball_x", now) * steps, self._LEFT, self._RIGHT)
        return self._steer(now["player_x"], np.clip(place - self._LEVEL + self._aim, *self._REACH), steps)
