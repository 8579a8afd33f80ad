"""Scripted policies: how well they play, that chance makes them worse, and the way a ball goes."""

from __future__ import annotations

import numpy as np
import pytest

from repdib_lightning.environments.atari_game import AtariGame
from repdib_lightning.environments.atari_paddles import PongScript, bounced
from repdib_lightning.environments.atari_policies import SCRIPTS
from repdib_lightning.environments.atari_qbert import QbertScript
from repdib_lightning.environments.atari_ram import VARIABLES

pytest.importorskip("ale_py")
pytest.importorskip("cv2")


def score(name: str, epsilon: float, steps: int, seed: int = 0) -> float:
    """Sum of rewards of the first steps of a game."""
    game = AtariGame(name, image_size=84, frame_skip=4, sticky=0.0, noop_max=30, max_frames=27_000)
    script, random = SCRIPTS[name](epsilon), np.random.default_rng(seed)
    game.reset(random, random)
    total = 0.0
    for _ in range(steps):
        total += game.step(script.act(game.ram(), random))
        if game.over:
            break
    return total


@pytest.mark.parametrize(
    ("name", "steps", "least", "most"),
    [("breakout", 1200, 60, 5), ("pong", 1600, 2, -5), ("qbert", 600, 2500, 800), ("seaquest", 900, 1000, 300)],
)
def test_scripts_play_well_and_chance_does_not(name, steps, least, most):
    assert score(name, 0.02, steps) >= least
    assert score(name, 1.0, steps) <= most


def test_chance_draws_every_action_alike():
    script, random = SCRIPTS["seaquest"](1.0), np.random.default_rng(0)
    drawn = np.bincount([script.act(np.zeros(128, np.uint8), random) for _ in range(3600)], minlength=18)
    assert len(drawn) == 18 and drawn.min() > 130 and drawn.max() < 280


@pytest.mark.parametrize("name", sorted(SCRIPTS))
def test_a_script_depends_on_the_game_and_its_generator_alone(name):
    """After another game, too."""
    script, fresh = SCRIPTS[name](0.2), SCRIPTS[name](0.2)
    memory = np.random.default_rng(1).integers(256, size=(60, 128), dtype=np.uint8)
    for ram in memory[::-1]:
        script.act(ram, np.random.default_rng(2))
    script.reset()
    ours, theirs = np.random.default_rng(3), np.random.default_rng(3)
    assert [script.act(ram, ours) for ram in memory] == [fresh.act(ram, theirs) for ram in memory]


def test_bounced_is_where_a_ball_gets_that_is_thrown_back_by_walls():
    for start, speed in ((50, 7), (60, -3), (100, 11)):
        place, direction = float(start), speed
        for step in range(1, 60):
            for _ in range(abs(speed)):  # one unit after another
                if not 46 <= place + np.sign(direction) <= 106:
                    direction = -direction
                place += np.sign(direction)
            assert bounced(start + speed * step, 46, 106) == place


def test_the_paddles_plans_are_what_the_paddle_does():
    """On average the foreseen place is within some pixels of where Pong's paddle gets."""
    game = AtariGame("pong", image_size=84, frame_skip=4, sticky=0.0, noop_max=30, max_frames=27_000)
    script, random, apart = PongScript(0.0), np.random.default_rng(0), []
    game.reset(random, random)
    for _ in range(30):
        game.step(0)
    moves = {0: 0, 1: 3, -1: 2}
    for _ in range(40):
        place = int(game.ram()[51])
        plan = int(random.integers(27))
        foreseen = [script._reached(place, steps)[plan] for steps in (1, 2, 3)]
        for planned, expected in zip(PongScript._PLANS[plan], foreseen, strict=True):
            action = moves[int(planned)]
            game.step(action)
            script._taken = [script._taken[1], script._meanings[action]]
            if 60 < place < 180:
                apart.append(abs(int(game.ram()[51]) - expected))
    assert len(apart) > 40 and np.median(apart) <= 3 and np.quantile(apart, 0.9) < 12


def qbert_standing_on(cube: tuple[int, int], unchanged: set[tuple[int, int]]) -> np.ndarray:
    ram = np.zeros(128, np.uint8)
    ram[43], ram[67] = QbertScript._COLUMNS[cube[0]][cube[1]], 25 + 28 * cube[0]
    for place, address in zip(QbertScript._CUBES, VARIABLES["qbert"]["cubes"].addresses, strict=True):
        ram[address] = 148 if place in unchanged else 26
    return ram


def distance(here: tuple[int, int], goal: tuple[int, int]) -> int:
    """Hops of a shortest way, by relaxation."""
    hops = dict.fromkeys(QbertScript._CUBES, 99) | {here: 0}
    for _ in hops:
        for row, column in hops:
            for down, across in QbertScript._HOPS.values():
                beyond = (row + down, column + across)
                if beyond in hops:
                    hops[beyond] = min(hops[beyond], hops[row, column] + 1)
    return hops[goal]


def test_qbert_hops_a_shortest_way():
    script, random = SCRIPTS["qbert"](0.0), np.random.default_rng(0)
    everywhere = set(QbertScript._CUBES)
    script.act(qbert_standing_on((0, 0), everywhere), random)  # the round begins: all are unchanged
    for here, goal in (((0, 0), (5, 0)), ((5, 5), (0, 0)), ((3, 1), (3, 3)), ((5, 2), (5, 3))):
        cube, hops = here, 0
        while cube != goal:
            meaning = script._meanings[script.act(qbert_standing_on(cube, {goal}), random)]
            down, across = QbertScript._HOPS[meaning]
            cube, hops = (cube[0] + down, cube[1] + across), hops + 1
            assert cube in everywhere
        assert hops == distance(here, goal)
    flying = qbert_standing_on((2, 1), {(0, 0)})
    flying[67] += 10
    assert script._meanings[script.act(flying, random)] == "NOOP"
