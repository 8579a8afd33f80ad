"""Drawn shapes: factors that are exactly known, independent, uniform, and each visible."""

from __future__ import annotations

import colorsys
import json
import math
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.stats import chi2

from repdib_lightning.__main__ import main
from repdib_lightning.data.episodes import EpisodeStore
from repdib_lightning.data.fingerprint import recompute_fingerprint
from repdib_lightning.data.shapes import GROUND_SATURATION, LEVELS, SHAPE_SATURATION, SUBPIXELS, draw_shape
from repdib_lightning.data.writer import EpisodeWriter
from repdib_lightning.environments.collect_shapes import collect_shapes
from repdib_lightning.errors import UserError

SMALL: dict[str, Any] = {"size": 16, "samples": 3000, "seed": 5, "progress": False}


@pytest.fixture(scope="module")
def path(tmp_path_factory) -> Path:
    return collect_shapes(tmp_path_factory.mktemp("shapes") / "shapes.h5", **SMALL)


@pytest.fixture(scope="module")
def store(path) -> EpisodeStore:
    return EpisodeStore(path)


def drawn(seed: int) -> dict[str, int]:
    random = np.random.default_rng(seed)
    return {name: int(random.integers(len(levels))) for name, levels in LEVELS.items()}


def levels_of(store: EpisodeStore, row: int) -> dict[str, int]:
    return {name: int(store.array(f"factors/{name}")[row]) for name in LEVELS}


def corners(shape: str, side: float, x: float, y: float) -> list[tuple[float, float]]:
    """Outline of a shape of area side ** 2, built from its textbook formulae; the top corner points up."""
    if shape == "square":
        return [(x + a * side / 2, y + b * side / 2) for a, b in ((-1, -1), (1, -1), (1, 1), (-1, 1))]
    if shape == "triangle":
        edge = side * 2 / 3**0.25
        above, below = edge / math.sqrt(3), edge / (2 * math.sqrt(3))
        return [(x, y - above), (x + edge / 2, y + below), (x - edge / 2, y + below)]
    notch = (3 - math.sqrt(5)) / 2  # of a pentagram, by the golden ratio
    outer = side / math.sqrt(5 * notch * math.sin(math.pi / 5))
    radii = [outer if corner % 2 == 0 else outer * notch for corner in range(10)]
    turns = [math.pi * corner / 5 for corner in range(10)]
    return [(x + r * math.sin(turn), y - r * math.cos(turn)) for r, turn in zip(radii, turns, strict=True)]


def holds(outline: list[tuple[float, float]], x: float, y: float) -> bool:
    """Whether a ray to the right crosses the outline an odd number of times."""
    crossings = 0
    for (ax, ay), (bx, by) in zip(outline, outline[1:] + outline[:1], strict=True):
        if (ay > y) != (by > y) and x < ax + (y - ay) / (by - ay) * (bx - ax):
            crossings += 1
    return crossings % 2 == 1


def slow_picture(levels: dict[str, int], size: int) -> np.ndarray:
    """Pixel by pixel, sample by sample: (3, H, W) floats, 0 to 255."""
    value: dict[str, Any] = {name: LEVELS[name][level] for name, level in levels.items()}
    ground = colorsys.hsv_to_rgb(value["background"] / 360, GROUND_SATURATION, 1)
    colour = colorsys.hsv_to_rgb(value["hue"] / 360, SHAPE_SATURATION, value["brightness"])
    x, y, side = value["horizontal"], value["vertical"], value["size"]
    outline = None if value["shape"] == "disc" else corners(value["shape"], side, x, y)
    picture = np.zeros((3, size, size))
    for row in range(size):
        for column in range(size):
            inside = 0
            for k in range(SUBPIXELS**2):
                px = (column + (k % SUBPIXELS + 0.5) / SUBPIXELS) / size
                py = (row + (k // SUBPIXELS + 0.5) / SUBPIXELS) / size
                near = math.pi * ((px - x) ** 2 + (py - y) ** 2) <= side**2
                inside += near if outline is None else holds(outline, px, py)
            share = inside / SUBPIXELS**2
            for channel in range(3):
                picture[channel, row, column] = 255 * (share * colour[channel] + (1 - share) * ground[channel])
    return picture


@pytest.mark.parametrize("shape", range(4))
@pytest.mark.parametrize("size", [16, 29])
def test_a_slow_renderer_agrees(shape, size):
    for seed in range(3):
        levels = {**drawn(100 * shape + seed), "shape": shape}
        gap = np.abs(draw_shape(levels, size) - slow_picture(levels, size))
        assert gap.max() <= 1.01, (levels, gap.max())  # both colours and their mixture are rounded


@pytest.mark.parametrize("name", LEVELS)
def test_any_two_levels_of_a_factor_differ_visibly(name):
    """At least 20 pixels of 64 x 64 differ by 30 of 255 or more, whatever the other factors are."""
    for seed in range(40):
        others = drawn(seed)
        pictures = [draw_shape({**others, name: level}, 64).astype(int) for level in range(len(LEVELS[name]))]
        for first, second in combinations(pictures, 2):
            assert (np.abs(first - second).max(axis=0) >= 30).sum() >= 20


@pytest.mark.parametrize("size", [16, 64])
@pytest.mark.parametrize("shape", range(4))
def test_places_move_the_whole_shape_and_nothing_else(shape, size):
    levels = {**drawn(0), "shape": shape, "size": 3, "background": 0}
    middle = draw_shape({**levels, "horizontal": 3, "vertical": 4}, size)
    for x in (0, 7):
        for y in (0, 7):
            moved = draw_shape({**levels, "horizontal": x, "vertical": y}, size)
            shift = ((y - 4) * size // 16, (x - 3) * size // 16)
            assert np.array_equal(moved, np.roll(middle, shift, axis=(1, 2)))


@pytest.mark.parametrize("size", [64, 100])
def test_no_shape_touches_the_edge(size):
    for shape in range(4):
        for place in (0, 7):
            at = {"shape": shape, "size": 3, "horizontal": place, "vertical": place}
            picture = draw_shape({**drawn(0), **at}, size).astype(int)
            edge = np.concatenate([picture[:, 0], picture[:, -1], picture[:, :, 0], picture[:, :, -1]], axis=1)
            assert (edge == edge[:, :1]).all()


def test_all_shapes_of_a_size_have_the_same_area_and_place():
    for size_level, side in enumerate(map(float, LEVELS["size"])):
        for shape in range(4):
            levels = {**drawn(3), "shape": shape, "size": size_level, "horizontal": 2, "vertical": 5}
            picture = draw_shape(levels, 256).astype(float)
            ground = picture[:, :1, :1]
            centre = (int(256 * LEVELS["vertical"][5]), int(256 * LEVELS["horizontal"][2]))
            middle = picture[:, centre[0], centre[1], None, None]
            cover = ((picture - ground) * (middle - ground)).sum(0) / ((middle - ground) ** 2).sum()
            assert cover.sum() / 256**2 == pytest.approx(side**2, rel=0.02)
            at = (np.arange(256) + 0.5) / 256
            assert (cover.sum(0) @ at) / cover.sum() == pytest.approx(LEVELS["horizontal"][2], abs=1e-3)
            assert (cover.sum(1) @ at) / cover.sum() == pytest.approx(LEVELS["vertical"][5], abs=1e-3)


def test_stored_factors_are_those_of_the_picture_and_nothing_else_varies(store):
    for row in np.random.default_rng(0).choice(store.rows, 50, replace=False):
        assert np.array_equal(store.array("observations/pixels")[row], draw_shape(levels_of(store, int(row)), 16))


def test_layout(store):
    assert store.lengths.tolist() == [1] * 3000 and store.actions_spec is None
    assert {name: spec.shape for name, spec in store.observations.items()} == {"pixels": (3, 16, 16)}
    kinds = {name: (f.kind, f.scale, f.classes) for name, f in store.factors.items()}
    sizes = {"shape": 4, "hue": 8, "size": 4, "horizontal": 8, "vertical": 8, "brightness": 4, "background": 8}
    assert kinds == {name: ("endogenous", "categorical", count) for name, count in sizes.items()}
    named = json.loads(store.attributes["classes"])
    assert {name: len(classes) for name, classes in named.items()} == sizes and named["shape"][3] == "star"
    assert recompute_fingerprint(store) == store.fingerprint


def test_factors_are_uniform_and_independent(store):
    """Chi-squared statistics of all counts and of all pairs stay below their 0.1 % tails."""
    columns = {name: np.asarray(store.array(f"factors/{name}")) for name in LEVELS}
    columns["held out"] = store.evaluation.astype(int)
    for name in LEVELS:
        counts = np.bincount(columns[name], minlength=len(LEVELS[name]))
        assert chi_squared(counts, np.full(len(counts), counts.mean())) < chi2.ppf(0.999, len(counts) - 1)
    for first, second in combinations(columns, 2):
        a, b = columns[first], columns[second]
        table = np.zeros((a.max() + 1, b.max() + 1))
        np.add.at(table, (a, b), 1)
        expected = table.sum(1, keepdims=True) * table.sum(0, keepdims=True) / table.sum()
        freedom = (table.shape[0] - 1) * (table.shape[1] - 1)
        assert chi_squared(table, expected) < chi2.ppf(0.999, freedom), (first, second)


def chi_squared(counts: np.ndarray, expected: np.ndarray) -> float:
    return float(((counts - expected) ** 2 / expected).sum())


def test_the_share_that_is_held_out(store, tmp_path):
    assert store.evaluation.sum() == 600
    held = np.flatnonzero(store.evaluation)
    assert np.ptp(np.diff(held)) > 0  # at random, not every fifth
    none = EpisodeStore(collect_shapes(tmp_path / "none.h5", samples=10, size=16, held_out=0, progress=False))
    assert not none.evaluation.any()


def test_the_same_seed_gives_the_same_bytes(path, store, tmp_path):
    assert collect_shapes(tmp_path / "again.h5", **SMALL).read_bytes() == path.read_bytes()
    other = EpisodeStore(collect_shapes(tmp_path / "other.h5", **{**SMALL, "seed": 6}))
    assert not np.array_equal(other.array("factors/hue"), store.array("factors/hue"))
    assert not np.array_equal(other.evaluation, store.evaluation)


def test_the_verb_collects_and_inspects(tmp_path, capsys):
    out = tmp_path / "shapes.h5"
    assert main(["collect", "shapes", str(out), "--samples", "20", "--size", "24"]) == 0
    said = capsys.readouterr()
    assert said.out == f"wrote {out}\n" and said.err == ""
    assert EpisodeStore(out).observations["pixels"].shape == (3, 24, 24)
    assert main(["inspect", str(out)]) == 0


WRONG: list[dict[str, Any]] = [
    *({"samples": 0}, {"seed": -1}, {"size": 15}, {"size": 513}),
    *({"held_out": 1}, {"held_out": -0.1}, {"held_out": float("nan")}, {"held_out": 0.99, "samples": 10}),
]


@pytest.mark.parametrize("options", WRONG)
def test_wrong_options_are_refused(tmp_path, options):
    with pytest.raises(UserError, match=f"^{next(iter(options))}=[^\n]*must be [^\n]*$"):
        collect_shapes(tmp_path / "x.h5", **{**SMALL, **options})
    assert not list(tmp_path.iterdir())


def test_what_an_interruption_leaves_is_no_store(tmp_path, monkeypatch):
    done: list[bool] = []
    add = EpisodeWriter.add_episode

    def stop_after_ten(writer: EpisodeWriter, **episode: Any) -> None:
        if len(done) == 10:
            raise KeyboardInterrupt
        add(writer, **episode)
        done.append(True)

    monkeypatch.setattr(EpisodeWriter, "add_episode", stop_after_ten)
    with pytest.raises(KeyboardInterrupt):
        collect_shapes(tmp_path / "x.h5", **SMALL)
    assert len(done) == 10 and not list(tmp_path.iterdir())
