"""A scripted policy of Seaquest."""

from __future__ import annotations

import numpy as np

from repdib_lightning.environments.atari_script import Script


class SeaquestScript(Script):
    """Shoots at the nearest fish or fetches the nearest diver, keeps away from fish, and surfaces for air in time.

    It sees neither sharks' companions nor what the enemy submarines shoot.
    """

    game = "seaquest"

    _LANES = (105, 81, 57, 33)
    """The player's place level with each lane of fish and divers, from the bottom up."""
    _SEEN = 168
    """Larger places of fish are beyond the edges of the screen."""
    _EDGES = (30, 125)
    _SURFACE, _BELOW = 16, 25
    _SHORT, _FULL, _LAST, _ENOUGH = 20, 62, 6, 60
    """Of air: when to rise, when to dive again, when to rise whatever is in the way, and what makes diving worth it."""
    _DIVERS = 6
    """That many fill the submarine."""

    def reset(self) -> None:
        """Forget the game before."""
        super().reset()
        self._rising = False

    def _choose(self, now: dict[str, int], ram: np.ndarray, random: np.random.Generator) -> str:
        x, y, air = now["player_x"], now["player_y"], now["oxygen"]
        enemies = self._all("enemy_x", ram)
        fish = [(place - x, lane - y) for place, lane in zip(enemies, self._LANES, strict=True) if place <= self._SEEN]
        if air < self._SHORT or now["divers"] >= self._DIVERS:
            self._rising = True
        elif air >= self._FULL and y < self._BELOW:
            self._rising = False
        close = [across for across, down in fish if abs(down) < 20 and abs(across) < 26]
        if close and y > self._SURFACE:
            return self._flee(min(close, key=abs), x, now["player_direction"])
        if self._rising:
            return "FIRE" if _blocked(fish, -1) and y > self._BELOW and air > self._LAST else "UPFIRE"
        if y <= self._SURFACE:
            return "FIRE" if air < self._ENOUGH or _blocked(fish, 1) else "DOWNFIRE"
        return self._hunt(now, fish, self._all("diver_x", ram))

    def _flee(self, across: int, x: int, direction: int) -> str:
        """From a fish so far to the right; where there is no room, shoot it."""
        towards, away = ("RIGHT", "LEFT") if across > 0 else ("LEFT", "RIGHT")
        if x < self._EDGES[0] if away == "LEFT" else x > self._EDGES[1]:
            return ("" if _faces(direction, across) else towards) + "FIRE"
        return away + "FIRE"

    def _hunt(self, now: dict[str, int], fish: list[tuple[int, int]], divers: list[int]) -> str:
        """Towards what is nearest; lanes count more than what lies in one."""
        goals = [(abs(down) + 0.3 * abs(across), True, across, down) for across, down in fish if abs(across) >= 26]
        for place, lane in zip(divers, self._LANES, strict=True):
            across, down = place - now["player_x"], lane - now["player_y"]
            if place and now["divers"] < self._DIVERS:
                goals.append((abs(down) + 0.5 * abs(across) - 10, False, across, down))
        if not goals:
            return "FIRE"
        _, is_fish, across, down = min(goals)
        vertical = "DOWN" if down > 3 else "UP" if down < -3 else ""
        if vertical and _blocked(fish, 1 if down > 0 else -1):
            vertical = ""
        aimed = is_fish and abs(across) < 70 and _faces(now["player_direction"], across)
        return vertical + ("" if aimed else "RIGHT" if across > 0 else "LEFT") + "FIRE"


def _faces(direction: int, across: int) -> bool:
    return (direction == 0) == (across > 0)


def _blocked(fish: list[tuple[int, int]], way: int) -> bool:
    """Whether a fish is so near that it would be met a little higher (-1) or lower (1)."""
    return any(abs(across) < 32 and abs(down - 12 * way) < 20 and down * way > -6 for across, down in fish)
