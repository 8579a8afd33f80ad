"""Each variable of a console's memory is what the screen shows: found by its colour, or told by the rewards."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import pytest

from repdib_lightning.environments.atari_game import AtariGame
from repdib_lightning.environments.atari_policies import SCRIPTS
from repdib_lightning.environments.atari_ram import VARIABLES, Variable, ram_factor_specs, ram_factors

pytest.importorskip("ale_py")
pytest.importorskip("cv2")

RED, GREEN, ORANGE, WHITE = (200, 72, 72), (92, 186, 92), (213, 130, 74), (236, 236, 236)
YELLOW, BLUE, PAINTED, PLAIN = (187, 187, 53), (66, 72, 200), (210, 210, 64), (45, 87, 176)


def code(colour: tuple[int, int, int]) -> int:
    """A colour as one number."""
    return 65536 * colour[0] + 256 * colour[1] + colour[2]


@dataclass
class Seen:
    """(T, 210, 160) screens, a colour as one number; name -> (T, ...) factors; returns and lives, (T,) each."""

    screens: np.ndarray
    factors: dict[str, np.ndarray]
    returns: np.ndarray
    lives: np.ndarray

    def blob(self, colour: tuple[int, int, int], top: int, bottom: int, pixels: int) -> tuple[np.ndarray, ...]:
        """Where there are so many pixels of a colour: (T,) bool, and their mean row and column."""
        found = self.screens[:, top:bottom, 8:152] == code(colour)
        count = found.sum((1, 2))
        rows = (found.sum(2) * np.arange(top, bottom)).sum(1) / np.maximum(count, 1)
        columns = (found.sum(1) * np.arange(8, 152)).sum(1) / np.maximum(count, 1)
        return count == pixels, rows, columns


def look(name: str, steps: int, epsilon: float, every: int = 1, seed: int = 0) -> Seen:
    game = AtariGame(name, image_size=84, frame_skip=4, sticky=0.0, noop_max=30, max_frames=27_000)
    script, random = SCRIPTS[name](epsilon), np.random.default_rng(seed)
    game.reset(random, random)
    screens, memory, returns, lives, total = [], [], [], [], 0.0
    for step in range(steps):
        total += game.step(script.act(game.ram(), random))
        if game.over:
            break
        if step % every == 0:
            screens.append(game._console.getScreenRGB() @ np.array([65536, 256, 1], np.int32))
            memory.append(game.ram())
            returns.append(total)
            lives.append(game.lives())
    return Seen(np.stack(screens), ram_factors(name, np.stack(memory)), np.array(returns), np.array(lives))


def follows(value: np.ndarray, place: np.ndarray, where: np.ndarray, most: float, way: int = 20) -> None:
    """The variable and the place differ by a constant."""
    assert where.sum() > 20 and np.ptp(value[where]) > way
    apart = place[where] - value[where]
    assert np.abs(apart - np.median(apart)).max() <= most


@pytest.fixture(scope="module")
def breakout() -> Seen:
    return look("breakout", 1500, 0.02, every=3)


def test_breakouts_paddle_and_ball(breakout):
    found, _, across = breakout.blob(RED, 189, 193, 64)
    follows(breakout.factors["player_x"], across, found & (across < 140), 0)
    found, down, across = breakout.blob(RED, 93, 189, 8)
    follows(breakout.factors["ball_x"], across, found, 0)
    follows(breakout.factors["ball_y"], down, found, 0)


def test_breakouts_wall_score_and_lives(breakout):
    wall = (breakout.screens[:, 57:93, 8:152] > 0).sum((1, 2))
    bricks = breakout.factors["bricks"]
    assert np.ptp(bricks) >= 40 and np.corrcoef(bricks, wall)[0, 1] > 0.999
    assert np.array_equal(breakout.factors["score"], breakout.returns) and breakout.returns[-1] > 100
    assert np.array_equal(breakout.factors["lives"], breakout.lives)


def test_pongs_paddles_ball_and_scores():
    seen = look("pong", 1000, 0.3, every=3)
    for name, colour, pixels in (("player_y", GREEN, 64), ("enemy_y", ORANGE, 64)):
        screens = seen.screens[:, 34:194] == code(colour)
        count = screens.sum((1, 2))
        down = (screens.sum(2) * np.arange(34, 194)).sum(1) / np.maximum(count, 1)
        follows(seen.factors[name], down, count == pixels, 1)
    found, down, across = seen.blob(WHITE, 34, 194, 8)
    follows(seen.factors["ball_x"], across, found, 0)
    follows(seen.factors["ball_y"], down, found, 1.5)
    scores = seen.factors["player_score"] - seen.factors["enemy_score"]
    assert np.array_equal(scores, seen.returns) and np.abs(scores).max() >= 2


@pytest.fixture(scope="module")
def seaquest() -> Seen:
    return look("seaquest", 1100, 0.02, every=2)


def test_seaquests_submarine(seaquest):
    ship = seaquest.screens[:, 46:160, 8:160] == code(YELLOW)
    whole = ship.sum((1, 2)) >= 84
    left, right = ship.any(1).argmax(1) + 8, 159 - ship.any(1)[:, ::-1].argmax(1)
    alone = whole & (right - left <= 16)
    follows(seaquest.factors["player_x"], left, alone, 1)
    down = (ship.sum(2) * np.arange(46, 160)).sum(1) / np.maximum(ship.sum((1, 2)), 1)
    follows(seaquest.factors["player_y"], down, alone, 1)
    across = (ship.sum(1) * np.arange(8, 160)).sum(1) / np.maximum(ship.sum((1, 2)), 1)
    heavier = across - (left + right) / 2  # the stern
    facing = seaquest.factors["player_direction"]
    assert set(np.unique(facing)) == {0, 8}
    assert heavier[alone & (facing == 0)].mean() > 0.2 and heavier[alone & (facing == 8)].mean() < -0.2


def test_seaquests_torpedo(seaquest):
    ship = seaquest.screens[:, 46:160, 8:160] == code(YELLOW)
    across, torpedo = np.arange(8, 160), seaquest.factors["missile_x"]
    apart = []
    for step in np.flatnonzero(torpedo > 0):
        place = seaquest.factors["player_x"][step]
        columns = across[ship[step].any(0) & ((across < place - 4) | (across > place + 26))]
        if 4 <= len(columns) <= 8:
            apart.append(columns[0] - torpedo[step])
    assert len(apart) > 50 and min(apart) >= 0 and max(apart) <= 4


def test_seaquests_lanes(seaquest):
    """A lane's fish are where its variable says, or 32 or 64 further where the first of a group is gone."""
    tops = (136, 112, 88, 64)
    background = [(0, 28, 136), BLUE, YELLOW, (0, 0, 0), (24, 59, 157), (0, 68, 0), WHITE, (142, 142, 142)]
    lanes = seaquest.screens[:, :160]
    free = np.zeros(lanes.shape[:3], bool)
    for colour in background:
        free |= lanes == code(colour)
    for lane, top in enumerate(tops):
        found = ~free[:, top : top + 17, 8:160]
        left, right = found.any(1).argmax(1) + 8, 159 - found.any(1)[:, ::-1].argmax(1)
        one = (found.sum((1, 2)) > 15) & (left > 20) & (right < 148) & (right - left < 12)
        apart = (left - seaquest.factors["enemy_x"][:, lane])[one] % 256
        assert one.sum() > 20 and np.isin(apart, [0, 32, 64]).mean() > 0.9
        diver = lanes[:, top : top + 17, 8:160] == code(BLUE)
        count = diver.sum((1, 2))
        across = (diver.sum(1) * np.arange(8, 160)).sum(1) / np.maximum(count, 1)
        value = seaquest.factors["diver_x"][:, lane]
        alone = (count >= 15) & (across > 20) & (across < 148) & (value > 0)
        if alone.sum() > 20:
            follows(value, across, alone, 1.0, way=5)


def test_seaquests_air_divers_score_and_lives(seaquest):
    bar = (seaquest.screens[:, 172, 49:112] == code((214, 214, 214))).sum(1)
    assert np.ptp(bar) > 30 and np.abs(bar - seaquest.factors["oxygen"]).max() <= 3
    icons = (seaquest.screens[:, 176:188, 50:120] == code((24, 26, 167))).sum((1, 2))
    divers = seaquest.factors["divers"]
    one = icons[divers == 1].max()
    assert divers.max() >= 4 and (np.abs(icons[icons > 0] - one * divers[icons > 0]) == 0).all()
    assert np.array_equal(seaquest.factors["score"], seaquest.returns) and seaquest.returns[-1] > 500
    assert np.array_equal(seaquest.factors["lives"] + 1, seaquest.lives)


def test_qberts_cubes_player_and_score():
    seen = look("qbert", 400, 0.0)
    tops = {0: (78,), 1: (66, 94), 2: (54, 78, 106), 3: (42, 66, 94, 118), 4: (30, 54, 78, 106, 130),
            5: (18, 42, 66, 94, 118, 142)}  # fmt: skip
    places = [((36, 64, 93, 122, 151, 180)[row], column) for row, columns in tops.items() for column in columns]
    mixed = np.ptp(seen.factors["cubes"], axis=1) > 0
    begin = int(mixed.argmax())
    until = begin + int((~mixed[begin:]).argmax())  # all are changed: the first round ends
    assert until > begin + 100
    changed = 0
    for (y, x), colours in zip(places, seen.factors["cubes"][:until].T, strict=True):
        pixels = seen.screens[:until, y, x]
        painted, plain = ((pixels == code(colour)) for colour in (PAINTED, PLAIN))
        told = colours == 26
        changed += told.any() and not told.all()
        assert ((told == painted) | ~(painted | plain)).mean() > 0.98, (y, x)
    assert changed >= 20  # the last one ends the round
    assert np.array_equal(seen.factors["score"], seen.returns) and seen.returns[-1] > 1000


def test_qberts_player():
    seen = look("qbert", 400, 0.1)
    body = seen.screens[:, 10:195] == code((181, 83, 40))
    count = body.sum((1, 2))
    whole = (count > 70) & (count < 84)
    across = (body.sum(1) * np.arange(160)).sum(1) / np.maximum(count, 1)
    down = (body.sum(2) * np.arange(10, 195)).sum(1) / np.maximum(count, 1)
    for name, place in (("player_x", across), ("player_y", down)):
        apart = np.abs((place - seen.factors[name])[whole] - np.median((place - seen.factors[name])[whole]))
        assert whole.sum() > 50 and np.quantile(apart, 0.9) < 8
        assert np.corrcoef(place[whole], seen.factors[name][whole])[0, 1] > 0.97


@pytest.mark.parametrize(
    ("variable", "read"),
    [
        (Variable((1,)), lambda ram: float(ram[1])),
        (Variable((2, 0)), lambda ram: [float(ram[2]), float(ram[0])]),
        (Variable((3, 4), "bits"), lambda ram: float(sum(bin(int(ram[i])).count("1") for i in (3, 4)))),
        (Variable((5, 6, 7), "decimal"), lambda ram: float("".join(f"{int(ram[i]):02x}" for i in (5, 6, 7)))),
    ],
)
def test_bytes_are_read_one_by_one_as_bits_or_as_digits(variable: Variable, read: Callable[[np.ndarray], object]):
    random = np.random.default_rng(0)
    ram = random.integers(256, size=(5, 2, 128), dtype=np.uint8)
    ram[..., 5:8] = random.integers(10, size=(5, 2, 3)) * 16 + random.integers(10, size=(5, 2, 3))
    found = variable.of(ram)
    assert found.dtype == np.float32 and found.shape == (5, 2, *((2,) if variable.width == 2 else ()))
    for place in np.ndindex(5, 2):
        assert found[place].tolist() == read(ram[place])


def test_specs_fit_the_factors():
    for game, variables in VARIABLES.items():
        specs, found = ram_factor_specs(game), ram_factors(game, np.zeros((3, 128), np.uint8))
        assert specs.keys() == found.keys() == variables.keys()
        for name, spec in specs.items():
            assert (spec.kind, spec.scale, spec.classes) == ("endogenous", "continuous", 0)
            assert found[name].shape == ((3,) if spec.width == 1 else (3, spec.width))
    assert ram_factors("tennis", np.zeros(128, np.uint8)) == {} == ram_factor_specs("tennis")
