"""The store of drawings: factors agree with the picture, whole combinations are held out, bad input leaves nothing."""

from __future__ import annotations

import colorsys
import json
import shutil
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from deep_pictures import sixteen_bit_rgb
from PIL import Image

from repdib_lightning.__main__ import main
from repdib_lightning.data.episodes import EpisodeStore
from repdib_lightning.data.fingerprint import recompute_fingerprint
from repdib_lightning.environments.collect_emoji_styles import collect_emoji_styles
from repdib_lightning.errors import UserError

COMMITTED = Path(__file__).parents[3] / "data" / "emoji_styles"
STYLES = ("emojione", "fluent-emoji-high-contrast", "noto", "openmoji", "twemoji")
SPECIES = ("ant", "crab", "elephant", "fox", "owl", "whale")
WIDTHS = (0.55, 0.75, 0.95)


def copy_drawings(folder: Path, styles=STYLES, species=SPECIES) -> Path:
    for style in styles:
        (folder / style).mkdir(parents=True)
        for name in species:
            shutil.copy(COMMITTED / style / f"{name}.png", folder / style)
    return folder


@pytest.fixture(scope="module")
def source(tmp_path_factory) -> Path:
    return copy_drawings(tmp_path_factory.mktemp("drawings") / "set")


def collect(source: Path, path: Path, **options: Any) -> EpisodeStore:
    return EpisodeStore(collect_emoji_styles(path, source=source, progress=False, **options))


@pytest.fixture(scope="module")
def plain(source) -> EpisodeStore:
    return collect(source, source.parent / "plain.h5")


@pytest.fixture(scope="module")
def varied(source) -> EpisodeStore:
    return collect(source, source.parent / "varied.h5", variants=7, seed=3)


def named(store: EpisodeStore, name: str) -> list[str]:
    """What a factor is called in each row."""
    names = json.loads(store.attributes["classes"])[name]
    return [names[level] for level in store.array(f"factors/{name}")]


def combinations(store: EpisodeStore) -> list[tuple[str, str]]:
    return list(zip(named(store, "style"), named(store, "species"), strict=True))


def picture(store: EpisodeStore, row: int | np.integer[Any]) -> np.ndarray:
    """(H, W, 3) int64."""
    return store.array("observations/pixels")[row].transpose(1, 2, 0).astype(int)


def on_colour(file: Path, colour: tuple[int, ...]) -> Image.Image:
    """A drawing laid on a colour at its own size: Pillow alone."""
    with Image.open(file) as drawing:
        ground = Image.new("RGBA", drawing.size, (*colour, 255))  # type: ignore[arg-type]
        return Image.alpha_composite(ground, drawing.convert("RGBA")).convert("RGB")


@pytest.mark.parametrize(("name", "variants"), [("plain", 1), ("varied", 7)])
def test_every_species_is_there_in_every_style_equally_often(request, name, variants):
    store = request.getfixturevalue(name)
    assert Counter(combinations(store)) == {(style, kind): variants for style in STYLES for kind in SPECIES}
    assert (store.lengths == variants).all() and len(store.lengths) == 30 and store.actions_spec is None
    pairs = np.array(combinations(store)).reshape(30, variants, 2)
    assert (pairs == pairs[:, :1]).all()  # an episode is a drawing
    assert recompute_fingerprint(store) == store.fingerprint


def test_factors_of_the_plain_and_of_the_varied_pictures(plain, varied):
    counts = {"style": 5, "species": 6}
    for store, expected in ((plain, counts), (varied, counts | {"background": 8, "scale": 3})):
        kinds = {name: (spec.kind, spec.scale, spec.classes) for name, spec in store.factors.items()}
        assert kinds == {name: ("endogenous", "categorical", count) for name, count in expected.items()}
        assert {name: len(names) for name, names in json.loads(store.attributes["classes"]).items()} == expected


@pytest.mark.parametrize("size", [64, 40])
def test_a_plain_picture_is_the_drawing_on_white_resized(source, tmp_path, size):
    store = collect(source, tmp_path / "s.h5", size=size)
    for row, (style, kind) in enumerate(combinations(store)):
        drawn = on_colour(source / style / f"{kind}.png", (255, 255, 255)).resize((size, size), Image.Resampling.BOX)
        assert np.abs(picture(store, row) - np.asarray(drawn).astype(int)).max() <= 3, (style, kind)
        assert (picture(store, row)[0, 0] == 255).all()


def test_a_larger_picture_is_smooth(source, tmp_path):
    store = collect(source, tmp_path / "s.h5", size=224)
    row = combinations(store).index(("noto", "elephant"))
    drawn = on_colour(source / "noto" / "elephant.png", (255, 255, 255)).resize((224, 224), Image.Resampling.BILINEAR)
    assert np.abs(picture(store, row) - np.asarray(drawn).astype(int)).max() <= 3


def test_the_corner_has_the_hue_of_the_background(varied):
    levels = varied.array("factors/background")
    colours = {
        level: {tuple(picture(varied, row)[0, 0]) for row in np.flatnonzero(levels == level)} for level in levels
    }
    assert set(colours) == set(range(8)) and all(len(found) == 1 for found in colours.values())
    for row, degrees in enumerate(named(varied, "background")):
        red, green, blue = picture(varied, row)[0, 0] / 255
        hue, saturation, value = colorsys.rgb_to_hsv(red, green, blue)
        assert abs((360 * hue - float(degrees) + 180) % 360 - 180) < 1
        assert value == 1 and 0.3 < saturation < 0.4


def test_the_drawing_is_as_wide_as_its_scale_says_and_in_the_middle(source, varied):
    assert set(varied.array("factors/scale")) == {0, 1, 2}
    for row, (style, kind) in enumerate(combinations(varied)):
        width = float(named(varied, "scale")[row])
        assert width == WIDTHS[varied.array("factors/scale")[row]]
        shown = picture(varied, row)
        inside = np.abs(shown - shown[0, 0]).max(axis=-1) > 40
        with Image.open(source / style / f"{kind}.png") as drawing:
            opaque = np.asarray(drawing)[:, :, 3] > 127
        for axis in (0, 1):
            found, whole = (np.flatnonzero(mask.any(axis)) for mask in (inside, opaque))
            first, last = ((edge - 56) * width * 64 / 112 + 32 for edge in (whole[0], whole[-1] + 1))
            assert abs(found[0] - first) <= 3 and abs(found[-1] + 1 - last) <= 3, (style, kind, width)


def test_a_varied_picture_is_the_drawing_before_its_background(source, varied):
    for row in np.flatnonzero(varied.array("factors/scale") == 1)[:20]:
        style, kind = combinations(varied)[row]
        ground = tuple(int(part) for part in picture(varied, row)[0, 0])
        drawn = on_colour(source / style / f"{kind}.png", ground).resize((48, 48), Image.Resampling.BOX)
        assert np.abs(picture(varied, row)[8:56, 8:56] - np.asarray(drawn).astype(int)).max() <= 3


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("variants", [1, 3])
def test_whole_combinations_are_held_out_evenly_over_the_styles(source, tmp_path, seed, variants):
    store = collect(source, tmp_path / "s.h5", size=8, variants=variants, seed=seed)
    pairs = combinations(store)
    rows = store.evaluation[store.row_episodes]
    held = {pair for pair, out in zip(pairs, rows, strict=True) if out}
    assert not held & {pair for pair, out in zip(pairs, rows, strict=True) if not out}
    assert len(held) == round(0.2 * 30)
    by_style = Counter(style for style, _ in held)
    assert set(by_style) == set(STYLES) and max(by_style.values()) - min(by_style.values()) <= 1


def test_the_seed_decides_what_is_held_out_and_how_drawings_are_shown(source, tmp_path):
    options = {"size": 16, "variants": 2}
    first, again = (collect(source, tmp_path / f"{n}.h5", **options, seed=4).path.read_bytes() for n in "ab")
    assert first == again
    stores = [EpisodeStore(tmp_path / "a.h5"), collect(source, tmp_path / "c.h5", **options, seed=5)]
    for name in ("factors/background", "factors/scale"):
        assert (stores[0].array(name) != stores[1].array(name)).any()
    assert (stores[0].evaluation != stores[1].evaluation).any()
    assert combinations(stores[0]) == combinations(stores[1])


def test_a_drawing_that_is_not_square_keeps_its_proportions(tmp_path):
    folder = copy_drawings(tmp_path / "set", ("noto", "twemoji"), ("ant",))
    Image.new("RGBA", (40, 20), (10, 20, 30, 255)).save(folder / "noto" / "ant.png")
    shown = picture(collect(folder, tmp_path / "s.h5", size=40), 0)
    assert (shown[10:30] == (10, 20, 30)).all() and (shown[:10] == 255).all() and (shown[30:] == 255).all()


def test_what_spoils_the_factorial_is_told(tmp_path, capsys):
    folder = copy_drawings(tmp_path / "set", ("noto", "twemoji"), ("ant", "crab"))
    collect(folder, tmp_path / "whole.h5", size=8)
    assert capsys.readouterr().err == ""
    (folder / "noto" / "crab.png").unlink()
    collect(folder, tmp_path / "less.h5", size=8)
    assert capsys.readouterr().err == f"{folder}: 1 of 4 combinations have no picture: noto/crab\n"
    shutil.rmtree(folder / "noto")
    collect(folder, tmp_path / "one.h5", size=8)
    assert capsys.readouterr().err == f"{folder}: 'style' is always 'twemoji': nothing can be measured of it\n"


def test_the_verb_collects_and_inspects(source, tmp_path, capsys):
    out = tmp_path / "s.h5"
    words = ["collect", "emoji_styles", str(out), "--source", str(source), "--variants", "2", "--size", "16"]
    assert main(words) == 0
    assert capsys.readouterr().out == f"wrote {out}\n"
    assert EpisodeStore(out).rows == 60
    assert main(["inspect", str(out)]) == 0


def refuse(source: Path, path: Path, *words: str, **options: Any) -> None:
    with pytest.raises(UserError) as caught:
        collect(source, path, **options)
    message = str(caught.value)
    assert "\n" not in message and all(word in message for word in words), message
    assert not path.parent.exists() or not list(path.parent.iterdir())


@pytest.mark.parametrize(
    "options",
    [
        *({"size": 7}, {"variants": 0}, {"seed": -1}),
        *({"held_out": 0.0}, {"held_out": 1.0}, {"held_out": -0.1}, {"held_out": float("nan")}),
    ],
)
def test_numbers_out_of_range_are_refused(source, tmp_path, options):
    ((name, value),) = options.items()
    refuse(source, tmp_path / "out" / "s.h5", name, str(value), **options)


def test_folders_without_drawings_are_refused(source, tmp_path):
    out = tmp_path / "out" / "s.h5"
    refuse(tmp_path / "nowhere", out, "nowhere: no such folder", "<domain>/<class>.png")
    refuse(source / "noto" / "ant.png", out, "is a file")
    (tmp_path / "empty").mkdir()
    refuse(tmp_path / "empty", out, "empty: holds no pictures")
    refuse(copy_drawings(tmp_path / "single", ("noto",), ("ant",)), out, "ant.png: the only drawing in", "two")


def test_drawings_that_cannot_be_used_are_named_and_leave_nothing(tmp_path):
    folder, out = copy_drawings(tmp_path / "set", ("noto", "twemoji"), ("ant", "crab")), tmp_path / "out" / "s.h5"
    last = folder / "twemoji" / "crab.png"
    whole = last.read_bytes()
    for content in (b"no picture", b"", whole[: len(whole) // 2]):
        last.write_bytes(content)
        refuse(folder, out, "twemoji/crab.png: not a readable picture")
    Image.fromarray(np.full((9, 9), 40_000, np.uint16)).save(last)
    refuse(folder, out, "twemoji/crab.png: has more than 8 bits a channel")
    sixteen_bit_rgb(last)
    refuse(folder, out, "twemoji/crab.png: has more than 8 bits a channel")
    last.write_bytes(whole)
    last.with_suffix(".jpg").write_bytes(whole)
    refuse(folder, out, "crab.png: a second drawing", "crab.jpg")


def test_a_drawing_that_claims_to_be_huge_is_refused(tmp_path, monkeypatch):
    folder = copy_drawings(tmp_path / "set", ("noto", "twemoji"), ("ant",))
    monkeypatch.setattr(Image, "MAX_IMAGE_PIXELS", 1000)
    refuse(folder, tmp_path / "out" / "s.h5", "noto/ant.png: not a readable picture")


def test_an_existing_store_stays_unless_it_is_to_be_replaced(source, tmp_path):
    path = collect(source, tmp_path / "s.h5", size=8).path
    before = path.read_bytes()
    with pytest.raises(UserError, match="exists already"):
        collect(source, path, size=9)
    assert path.read_bytes() == before
    assert collect(source, path, size=9, overwrite=True).observations["pixels"].shape == (3, 9, 9)
