"""Frames side by side: in each column a heading, one tile for every observation, and lines of text."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from repdib_lightning.data.episodes import EpisodeStore
from repdib_lightning.data.inspection_text import short_number

PAPER, INK, FAINT = (255, 255, 255), (32, 36, 44), (112, 118, 130)
MARGIN = 20
"""Colours of the sheet and of what is written on it; pixels left free at its sides."""

TILE, GAP, PANEL = 128, 8, (238, 240, 244)
"""Pixels of the side of a tile and between tiles; colour of one that shows no picture."""

_LINE, _HEADING = 15, 15


def font(size: int) -> ImageFont.FreeTypeFont | ImageFont.ImageFont:
    """Pillow's own typeface, which is there on every machine."""
    return ImageFont.load_default(size)


def width_of(columns: int) -> int:
    """Pixels that so many columns take, margins included."""
    return 2 * MARGIN + columns * (TILE + GAP) - GAP


def draw_columns(
    store: EpisodeStore, rows: np.ndarray, headings: Sequence[str], texts: Sequence[Sequence[str]]
) -> Image.Image:
    """Draw one column for each row of a store.

    Pictures with 1 or 3 channels are shown as they are, of any other number the last three (the newest frame of a
    stack); observations that are no pictures show their smallest and largest value.

    Args:
        store: where the rows live.
        rows: (n,) int64.
        headings: what stands above each column.
        texts: the lines below each column.
    """
    pictures_first = sorted(store.observations, key=lambda name: not store.observations[name].is_image)
    strips = {name: tiles_of(store, name, rows) for name in pictures_first}
    label = 18 if len(strips) > 1 else 0
    heights = {name: max(tile.height for tile in tiles) + label + GAP for name, tiles in strips.items()}
    lines = max(len(text) for text in texts)
    height = _HEADING + sum(heights.values()) + lines * _LINE + 16
    block = Image.new("RGB", (width_of(len(rows)), height), PAPER)
    pen = ImageDraw.Draw(block)
    for column, heading in enumerate(headings):
        pen.text((left_of(column), 0), _fit(pen, heading), fill=FAINT, font=font(11))
    top = _HEADING
    for name, tiles in strips.items():
        if label:
            pen.text((MARGIN, top + 2), name, fill=INK, font=font(12))
        for column, tile in enumerate(tiles):
            block.paste(tile, (left_of(column) + (TILE - tile.width) // 2, top + label))
        top += heights[name]
    for column, text in enumerate(texts):
        for number, line in enumerate(text):
            pen.text((left_of(column), top + number * _LINE), _fit(pen, line), fill=INK, font=font(11))
    return block


def left_of(column: int) -> int:
    """Where the tiles of a column begin, in pixels from the left."""
    return MARGIN + column * (TILE + GAP)


def _fit(pen: ImageDraw.ImageDraw, text: str) -> str:
    """Cut a text to the width of a tile."""
    while len(text) > 1 and pen.textlength(text, font=font(11)) > TILE:
        text = text[:-2] + "…"
    return text


def tiles_of(store: EpisodeStore, name: str, rows: np.ndarray) -> list[Image.Image]:
    """A tile for each of some rows of one observation; one that is no picture shows its extremes."""
    frames = store.gather(f"observations/{name}", rows)
    is_image = store.observations[name].is_image
    return [picture_tile(frame) if is_image else _extremes(frame) for frame in frames]


def picture_tile(frame: np.ndarray) -> Image.Image:
    """(C, H, W) uint8 -> a tile; pixels stay sharp where they grow by a whole factor."""
    shown = frame if len(frame) in (1, 3) else frame[-3:] if len(frame) > 3 else frame[:1]
    pixels = np.repeat(shown, 3, axis=0) if len(shown) == 1 else shown
    image = Image.fromarray(np.ascontiguousarray(pixels.transpose(1, 2, 0)))
    longest = max(image.size)
    size = (max(1, image.width * TILE // longest), max(1, image.height * TILE // longest))
    return image.resize(size, Image.Resampling.NEAREST if TILE % longest == 0 else Image.Resampling.LANCZOS)


def _extremes(values: np.ndarray) -> Image.Image:
    tile = Image.new("RGB", (TILE, 44), PANEL)
    pen = ImageDraw.Draw(tile)
    pen.text((8, 6), f"max {short_number(values.max())}", fill=INK, font=font(12))
    pen.text((8, 23), f"min {short_number(values.min())}", fill=INK, font=font(12))
    return tile
