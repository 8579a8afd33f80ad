"""Pictures of animals in several drawing styles, from the committed drawings: ``collect emoji_styles PATH``."""

from __future__ import annotations

import colorsys
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from PIL import Image
from tqdm import tqdm

from repdib_lightning.data.importers.combinations import notes_on_combinations
from repdib_lightning.data.importers.picture_folders import Picture, find_drawings
from repdib_lightning.data.importers.picture_splits import choose_held_out
from repdib_lightning.data.importers.square_picture import UNREADABLE, is_deep
from repdib_lightning.data.schema import FactorSpec
from repdib_lightning.data.writer import EpisodeWriter
from repdib_lightning.errors import UserError
from repdib_lightning.records import ArraySpec

BACKGROUNDS, SCALES = 8, (0.55, 0.75, 0.95)
"""Pale hues behind a variant, evenly spread over the colour circle; a drawing's width relative to the picture's."""


@dataclass(frozen=True)
class _Variant:
    """One way to show a drawing; the plain one is as large as the picture, on white."""

    background: int | None = None
    scale: int | None = None

    def show(self, drawing: Image.Image, size: int) -> np.ndarray:
        """Square drawing with transparency -> (3, size, size) uint8."""
        side = size if self.scale is None else round(SCALES[self.scale] * size)
        canvas = Image.new("RGBA", (size, size), (*_pale(self.background), 255))
        resampling = Image.Resampling.BOX if side <= drawing.width else Image.Resampling.BILINEAR
        resized = drawing.resize((side, side), resampling)  # Pillow weighs colours by their opacity
        canvas.alpha_composite(resized, ((size - side) // 2, (size - side) // 2))
        return np.ascontiguousarray(np.asarray(canvas.convert("RGB")).transpose(2, 0, 1))


def _pale(background: int | None) -> tuple[int, int, int]:
    if background is None:
        return 255, 255, 255
    red, green, blue = colorsys.hsv_to_rgb(background / BACKGROUNDS, 0.35, 1.0)
    return round(255 * red), round(255 * green), round(255 * blue)


def collect_emoji_styles(
    path: Path,
    *,
    source: Path = Path("data/emoji_styles"),
    size: int = 64,
    variants: int = 1,
    held_out: float = 0.2,
    seed: int = 0,
    overwrite: bool = False,
    progress: bool = True,
) -> Path:
    """Make a store of drawings: every species in every style; an episode is a drawing, a row one way to show it.

    Observation ``pixels``, (3, H, W) uint8, without actions. Factors, all categorical and endogenous: style (the
    folder), species (the file's name); with variants also background (8 pale hues, named by their degrees on the colour
    circle) and scale (3, named by the drawing's width relative to the picture's). What is held out are combinations of
    style and species, with all their variants. A combination without a drawing is told of, as is a factor that never
    changes.

    Args:
        path: the store to write (.h5).
        source: at least two drawings as ``<style>/<species>.png``, transparent around what they show; one that is not
            square stands in the middle of one.
        size: height and width in pixels.
        variants: how often each drawing is shown. Once: as large as the picture, on white. More often: each time at a
            size and before a background drawn at random.
        held_out: share of the combinations; as many of each style as of any other.
        seed: of what is held out, and of the variants.
        overwrite: replace an existing store.
        progress: show a progress bar on a terminal.

    Returns:
        The path.

    Raises:
        UserError: no such drawings, two of one combination, one that is unreadable or has more than 8 bits a channel,
            or a number out of range; no store is left.
    """
    if size < 8 or variants < 1 or seed < 0 or not 0 < held_out < 1:
        raise UserError(
            f"size must be at least 8, variants at least 1, seed not negative, held_out between 0 and 1; got {size}, "
            f"{variants}, {seed} and {held_out}"
        )
    drawings = _find(Path(source))
    classes = _classes(drawings, variants)
    kept_apart = choose_held_out(drawings, held_out, seed)
    writer = EpisodeWriter(
        path,
        rows=len(drawings) * variants,
        episodes=len(drawings),
        observations={"pixels": ArraySpec((3, size, size))},
        actions=None,
        factors={name: FactorSpec("endogenous", "categorical", len(names)) for name, names in classes.items()},
        attributes={
            "environment": "emoji_styles",
            "licence": "each style its own, see LICENCES.md beside the drawings",
            "seed": seed,
            "configuration": {"size": size, "variants": variants, "held_out": held_out},
            "classes": classes,
        },
        overwrite=overwrite,
    )
    random = np.random.default_rng(seed)
    shown = tqdm(drawings, desc="collect", unit="drawing", disable=None if progress else True)
    with writer:
        for drawing in shown:
            pixels, shows = zip(*_shown(drawing, classes, size, variants, random), strict=True)
            writer.add_episode(
                observations={"pixels": np.stack(pixels)},
                factors={name: np.array([levels[name] for levels in shows]) for name in classes},
                evaluation=drawing.key in kept_apart,
            )
    for line in notes_on_combinations(drawings, ("style", "species")):
        print(f"{source}: {line}", file=sys.stderr)
    return Path(path)


def _find(source: Path) -> list[Picture]:
    """All drawings; refuses what cannot be held out as a combination."""
    drawings = find_drawings(source)
    first: dict[tuple[str, str], Picture] = {}
    for drawing in drawings:
        other = first.setdefault((drawing.domain, drawing.label), drawing)
        if other is not drawing:
            raise UserError(f"{drawing.file}: a second drawing of this name beside {other.file.name}; keep one of them")
    if len(drawings) < 2:
        raise UserError(f"{drawings[0].file}: the only drawing in {source}; at least two are needed, to hold one out")
    return drawings


def _classes(drawings: Sequence[Picture], variants: int) -> dict[str, list[str]]:
    """Factor -> names of its classes."""
    classes = {
        "style": sorted({drawing.domain for drawing in drawings}),
        "species": sorted({drawing.label for drawing in drawings}),
    }
    if variants > 1:
        classes["background"] = [str(360 * level // BACKGROUNDS) for level in range(BACKGROUNDS)]
        classes["scale"] = [str(scale) for scale in SCALES]
    return classes


def _shown(
    drawing: Picture, classes: dict[str, list[str]], size: int, variants: int, random: np.random.Generator
) -> Iterator[tuple[np.ndarray, dict[str, int]]]:
    """Each variant of a drawing, with its class of every factor."""
    image = _read(drawing.file)
    fixed = {"style": classes["style"].index(drawing.domain), "species": classes["species"].index(drawing.label)}
    if variants == 1:
        yield _Variant().show(image, size), fixed
        return
    for _ in range(variants):
        background, scale = int(random.integers(BACKGROUNDS)), int(random.integers(len(SCALES)))
        yield _Variant(background, scale).show(image, size), {**fixed, "background": background, "scale": scale}


def _read(file: Path) -> Image.Image:
    """The drawing with its transparency, in the middle of a transparent square where it is none itself."""
    try:
        with Image.open(file) as picture:
            image = None if is_deep(file, picture.mode) else picture.convert("RGBA")
    except UNREADABLE as error:
        raise UserError(f"{file}: not a readable picture ({str(error).partition(chr(10))[0]})") from error
    if image is None:
        raise UserError(f"{file}: has more than 8 bits a channel; convert it to 8 bits")
    side = max(image.size)
    square = Image.new("RGBA", (side, side))
    square.paste(image, ((side - image.width) // 2, (side - image.height) // 2))
    return square
