"""The committed drawings: a full factorial of sound pictures with their licences; and the script that draws them."""

from __future__ import annotations

import importlib.util
import io
import json
import sys
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
import pytest
from PIL import Image

from repdib_lightning.errors import UserError

SET = Path(__file__).parents[3] / "data" / "emoji_styles"
LICENCES = {
    "emojione": "CC-BY-4.0",
    "fluent-emoji": "MIT",
    "fluent-emoji-flat": "MIT",
    "fluent-emoji-high-contrast": "MIT",
    "noto": "Apache-2.0",
    "openmoji": "CC-BY-SA-4.0",
    "twemoji": "CC-BY-4.0",
}


@pytest.fixture(scope="module")
def pictures() -> dict[str, np.ndarray]:
    """style/species -> (H, W, 3) uint8, on white."""
    read = {}
    for file in sorted(SET.glob("*/*.png")):
        with Image.open(file) as picture:
            assert (picture.format, picture.mode) == ("PNG", "RGBA"), file
            white = Image.new("RGBA", picture.size, "white")
            read[f"{file.parent.name}/{file.stem}"] = np.asarray(Image.alpha_composite(white, picture).convert("RGB"))
    return read


@pytest.fixture
def script() -> Iterator[ModuleType]:
    spec = importlib.util.spec_from_file_location("emoji_styles_make", SET / "make.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module  # dataclasses look their module up
    spec.loader.exec_module(module)
    yield module
    del sys.modules[spec.name]


def test_every_style_shows_exactly_the_species_of_the_list(pictures, script):
    assert {path.name for path in SET.iterdir() if path.is_dir() and path.name[0] not in "._"} == set(script.STYLES)
    assert set(pictures) == {f"{style}/{name}" for style in script.STYLES for name in script.SPECIES}
    assert {file.suffix for file in SET.glob("*/*")} == {".png"}
    assert "elephant" in script.SPECIES and len(script.SPECIES) >= 50
    assert set(LICENCES) == set(script.STYLES)


def test_the_list_holds_no_second_picture_of_an_animal_and_nothing_else_of_the_name(script):
    assert len(set(script.SPECIES)) == len(script.SPECIES)
    assert not [name for name in script.SPECIES if name.endswith("-face")]
    assert not {"cricket", "blossom", "cactus", "mushroom", "paw-prints", "pig-nose", "spider-web"} & set(
        script.SPECIES
    )


def test_pictures_are_squares_of_one_size(pictures):
    (shape,) = {pixels.shape for pixels in pictures.values()}
    assert shape[0] == shape[1] >= 96


def test_every_picture_shows_something_on_white(pictures):
    for name, pixels in pictures.items():
        white = (pixels >= 250).all(axis=-1)
        assert 0.1 < white.mean() < 0.9, name
        assert pixels.std() > 20, name
        border = np.concatenate([white[0], white[-1], white[:, 0], white[:, -1]])
        assert border.mean() > 0.4, name


def test_no_two_pictures_are_alike(pictures):
    names = list(pictures)
    # In blocks of 8 x 8 pixels: another compression makes no new drawing.
    coarse = np.stack([pixels.reshape(14, 8, 14, 8, 3).mean(axis=(1, 3)).ravel() for pixels in pictures.values()])
    squares = (coarse**2).sum(axis=1)
    distance = np.sqrt(np.maximum(squares[:, None] + squares - 2 * coarse @ coarse.T, 0) / coarse.shape[1])
    np.fill_diagonal(distance, np.inf)
    first, second = np.unravel_index(distance.argmin(), distance.shape)
    assert distance.min() > 3, (names[first], names[second], distance.min())


def test_high_contrast_has_no_colour_and_the_others_have(pictures):
    for name, pixels in pictures.items():
        if name.startswith("fluent-emoji-high-contrast/"):
            assert int(np.ptp(pixels.astype(int), axis=-1).max()) == 0, name
    for style in set(LICENCES) - {"fluent-emoji-high-contrast"}:
        assert np.ptp(pictures[f"{style}/crab"].astype(int), axis=-1).max() > 80, style


def test_all_pictures_together_stay_small():
    assert sum(file.stat().st_size for file in SET.glob("*/*.png")) < 4_000_000


def test_licences_name_every_style_with_origin_licence_and_changes():
    text = (SET / "LICENCES.md").read_text(encoding="utf-8")
    sections = {part.split("\n", 1)[0]: part for part in text.split("\n## ")[1:]}
    titles = {"MIT": "MIT", "Apache-2.0": "Apache 2.0", "CC-BY-4.0": "CC BY 4.0", "CC-BY-SA-4.0": "CC BY-SA 4.0"}
    for style, licence in LICENCES.items():
        section = sections[style]
        assert f"| licence | {titles[licence]}, https://" in section
        assert f"`@iconify-json/{style}` 1." in section
        assert "| author | " in section and "https://github.com/" in section
        assert "rendered to PNG, 112 x 112 px" in section
    assert "bear is its `bear-face`" in sections["emojione"]
    assert "stay under CC BY-SA 4.0" in text


def test_licences_hold_the_texts_that_must_be_passed_on():
    text = (SET / "LICENCES.md").read_text(encoding="utf-8")
    assert "Copyright (c) Microsoft Corporation." in text
    assert "The above copyright notice and this permission notice shall be included in all" in text
    assert 'Licensed under the Apache License, Version 2.0 (the "License");' in text
    assert "https://creativecommons.org/licenses/by/4.0/legalcode" in text
    assert "https://creativecommons.org/licenses/by-sa/4.0/legalcode" in text
    apache = (SET / "Apache-2.0.txt").read_text(encoding="utf-8")
    assert (
        "TERMS AND CONDITIONS FOR USE, REPRODUCTION, AND DISTRIBUTION" in apache and "9. Accepting Warranty" in apache
    )


def write_packs(root: Path, script: ModuleType, **changes: dict[str, Any]) -> Path:
    """Icon sets with a black square for every species; ``changes`` go into noto's icons.json."""
    for style, licence in LICENCES.items():
        icons = {"width": 36, "height": 36, "icons": {name: {"body": f"<{name}/>"} for name in script.SPECIES}}
        info = {
            "name": style.title(),
            "author": {"name": "Someone", "url": "https://example.org"},
            "license": {"title": licence, "spdx": licence, "url": "https://example.org/licence"},
        }
        package = {"name": f"@iconify-json/{style}", "version": "9.8.7"}
        folder = root / style
        folder.mkdir(parents=True)
        contents: dict[str, dict[str, Any]] = {"icons": icons, "info": info, "package": package}
        for name, content in contents.items():
            if style == "noto":
                content = {**content, **changes.get(name, {})}
            (folder / f"{name}.json").write_text(json.dumps(content))
    return root


@pytest.fixture
def renderer(monkeypatch) -> list[str]:
    """Stands in for resvg: half of every picture is black, the rest transparent. Returns the documents it was given."""
    given: list[str] = []

    def svg_to_bytes(svg_string: str, width: int, height: int) -> list[int]:
        given.append(svg_string)
        pixels = np.zeros((height, width, 4), np.uint8)
        pixels[:, : width // 2, 3] = 255
        content = io.BytesIO()
        Image.fromarray(pixels).save(content, "PNG")
        return list(content.getvalue())

    monkeypatch.setitem(sys.modules, "resvg_py", SimpleNamespace(svg_to_bytes=svg_to_bytes))
    return given


def test_the_script_keeps_what_is_transparent_and_drops_stale_pictures(tmp_path, script, renderer):
    packs, output = write_packs(tmp_path / "packs", script), tmp_path / "out"
    (output / "noto").mkdir(parents=True)
    (output / "noto" / "cricket.png").touch()
    written = script.make(packs, 16, output)
    files = sorted(output.glob("*/*.png"))
    assert len(files) == len(script.STYLES) * len(script.SPECIES)
    assert written == sum(file.stat().st_size for file in files)
    with Image.open(output / "noto" / "ant.png") as picture:
        assert (picture.mode, picture.size) == ("RGBA", (16, 16))
        assert np.asarray(picture)[:, :, 3].tolist() == [[255] * 8 + [0] * 8] * 16
    assert "| made from | Noto, icon set `@iconify-json/noto` 9.8.7 |" in (output / "LICENCES.md").read_text()


def test_an_alias_shows_its_parent_in_the_middle_of_a_square_around_the_icons_own_frame(tmp_path, script):
    icons = {"ant": {"body": '<path fill="currentColor"/>', "left": -2, "width": 40, "height": 30}}
    aliases = {"emmet": {"parent": "pismire"}, "pismire": {"parent": "ant"}}
    write_packs(tmp_path, script, icons={"icons": icons, "aliases": aliases})
    pack = script.read_pack(tmp_path, "noto")
    assert pack.original("emmet") == "ant"
    assert pack.svg("emmet") == pack.svg("ant")
    assert 'viewBox="-2 -5 40 40"' in pack.svg("ant")
    assert '<path fill="#000"/>' in pack.svg("ant")


def refuse(script: ModuleType, packs: Path, size: int = 16) -> str:
    output = packs.parent / "refused"
    with pytest.raises(UserError) as caught:
        script.make(packs, size, output)
    assert "\n" not in str(caught.value)
    assert not output.exists()
    return str(caught.value)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"icons": {"icons": {"ants": {"body": ""}}}}, ("noto/icons.json", "'ant'", "did you mean 'ants'")),
        ({"icons": {"icons": {}, "aliases": {"ant": {"parent": "x", "hFlip": True}}}}, ("alias 'ant'", "parent only")),
        (
            {"info": {"license": {"title": "X", "spdx": "CC-BY-NC-4.0", "url": "x"}}},
            ("noto/info.json", "CC-BY-NC-4.0", "Apache-2.0"),
        ),
    ],
)
def test_a_pack_that_cannot_be_used_is_refused_in_a_line_and_leaves_nothing(tmp_path, script, renderer, changes, words):
    message = refuse(script, write_packs(tmp_path / "packs", script, **changes))
    for word in words:
        assert word in message


def test_missing_folders_broken_files_sizes_and_a_missing_renderer_are_named(tmp_path, script, monkeypatch):
    packs = write_packs(tmp_path / "packs", script)
    assert "size must be from 16 to 512, got 8" in refuse(script, packs, 8)
    monkeypatch.setitem(sys.modules, "resvg_py", None)
    assert "resvg-py" in refuse(script, packs)
    (packs / "noto" / "info.json").write_text("{")
    assert "noto/info.json: is no JSON" in refuse(script, packs)
    (packs / "noto" / "info.json").unlink()
    assert "noto/info.json: cannot be read" in refuse(script, packs)
    assert "emojione: no such folder" in refuse(script, tmp_path / "nothing")
