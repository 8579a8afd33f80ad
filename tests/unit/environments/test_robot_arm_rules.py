"""Grid, actions and the planned noise, without rendering."""

from __future__ import annotations

import numpy as np
import pytest

from repdib_lightning.environments.robot_arm import (
    ACTIONS,
    CLIP_STEPS,
    Television,
    factor_specs,
    move,
    plan_noise,
)


@pytest.fixture(scope="module")
def television():
    return Television("procedural", 0)


def test_moves_on_the_grid():
    table = {
        "forward": [3, 4, 5, 6, 7, 8, 6, 7, 8],
        "back": [0, 1, 2, 0, 1, 2, 3, 4, 5],
        "left": [0, 0, 1, 3, 3, 4, 6, 6, 7],
        "right": [1, 2, 2, 4, 5, 5, 7, 8, 8],
        "stay": [0, 1, 2, 3, 4, 5, 6, 7, 8],
    }
    assert {name: [move(cell, a) for cell in range(9)] for a, name in enumerate(ACTIONS)} == table


def test_clip_numbers_of_the_splits_are_disjoint(television):
    train, held_out = television.numbers(False), television.numbers(True)
    assert (len(train), len(held_out), len(television)) == (12, 4, 16)
    assert not set(train) & set(held_out)
    clips = [television.clip(n) for n in range(16)]
    assert len({clip.tobytes() for clip in clips}) == 16


@pytest.mark.parametrize("evaluation", [False, True])
def test_the_tv_plays_clips_in_order_and_changes_them(television, evaluation):
    noise = plan_noise(np.random.default_rng(0), np.linspace(0, 1, 2000), television, evaluation)
    assert set(noise.video) == set(television.numbers(evaluation))
    cuts = np.flatnonzero(np.diff(noise.video)) + 1
    stretches = np.diff(cuts)
    assert stretches.min() >= CLIP_STEPS[0] and stretches.max() <= CLIP_STEPS[1]
    within = np.ones(1999, dtype=bool)
    within[cuts - 1] = False
    assert (np.diff(noise.frame)[within] % 48 == 1).all()


def test_lamps_and_flash_change_now_and_then(television):
    noise = plan_noise(np.random.default_rng(1), np.linspace(0, 1, 3000), television, False)
    changes = (np.diff(noise.lamps, axis=0) != 0).any(axis=-1).mean(axis=0)
    assert (np.abs(changes - 1 / 15) < 0.02).all()
    assert not (changes[0] == changes).all(), "lamps change independently"
    assert 0.15 < noise.flash.mean() < 0.32
    assert noise.lamps.min() >= 0 and noise.lamps.max() <= 1


def test_daylight_tells_the_time(television):
    noise = plan_noise(np.random.default_rng(2), np.arange(14_028) / 14_028, television, False)
    assert np.corrcoef(noise.ambient, noise.time_step)[0, 1] > 0.95
    assert (np.diff(noise.ambient[::1000]) < 0).any(), "a slow wave, not a ramp"
    assert noise.ambient.min() >= 0 and noise.ambient.max() <= 1 and noise.ambient.std() > 0.15


def test_factors_fit_their_specs(television):
    noise = plan_noise(np.random.default_rng(3), np.linspace(0, 0.9, 400), television, True)
    specs = factor_specs(len(television))
    factors = noise.factors(television)
    assert set(specs) == {"cell", *factors}
    assert [name for name, spec in specs.items() if spec.kind == "endogenous"] == ["cell"]
    for name, values in factors.items():
        spec = specs[name]
        assert values.shape == ((400,) if spec.width == 1 else (400, spec.width))
        if spec.scale == "categorical":
            assert values.dtype == np.int64 and values.min() >= 0 and values.max() < spec.classes
        else:
            assert values.dtype == np.float32 and values.min() >= 0 and values.max() <= 1
    assert np.allclose(factors["video_frame"] * 48, noise.frame)
