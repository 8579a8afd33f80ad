"""A picture of a store: a few episodes, each a row of frames over time, with actions and factors written below."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from repdib_lightning.data.episodes import EpisodeStore
from repdib_lightning.data.files import whole_file
from repdib_lightning.data.inspection_text import short_number

_PAPER, _INK, _FAINT, _PANEL = (255, 255, 255), (32, 36, 44), (112, 118, 130), (238, 240, 244)
_TILE, _GAP, _MARGIN, _LINE = 128, 8, 20, 15
_MOST_FACTORS = 8


def draw_contact_sheet(store: EpisodeStore, path: Path, *, episodes: int = 4, frames: int = 8) -> Path:
    """Write a PNG: ``episodes`` spread over the store, ``frames`` spread over each, first and last row included.

    Pictures with 1 or 3 channels are shown as they are, of any other number the last three (the newest frame of a
    stack); observations that are no pictures show their smallest and largest value.

    Raises:
        UserError: the PNG cannot be written.
    """
    chosen = np.unique(np.linspace(0, len(store.lengths) - 1, episodes).round().astype(int))
    blocks = [_draw_episode(store, int(episode), frames) for episode in chosen]
    width = max(_MARGIN * 2 + frames * (_TILE + _GAP) - _GAP, *(block.width for block in blocks))
    height = 64 + sum(block.height for block in blocks)
    sheet = Image.new("RGB", (width, height), _PAPER)
    pen = ImageDraw.Draw(sheet)
    pen.text((_MARGIN, 14), store.path.name, fill=_INK, font=_font(20))
    summary = f"{store.rows:,} rows in {len(store.lengths):,} episodes; {len(blocks)} of them, over time"
    pen.text((_MARGIN, 40), summary, fill=_FAINT, font=_font(13))
    top = 64
    for block in blocks:
        sheet.paste(block, (0, top))
        top += block.height
    with whole_file(path) as temporary:
        sheet.save(temporary, format="PNG")
    return path


def _font(size: int) -> ImageFont.FreeTypeFont | ImageFont.ImageFont:
    return ImageFont.load_default(size)


def _draw_episode(store: EpisodeStore, episode: int, frames: int) -> Image.Image:
    start, length = int(store.starts[episode]), int(store.lengths[episode])
    times = np.unique(np.linspace(0, length - 1, frames).round().astype(int))
    rows = start + times
    pictures_first = sorted(store.observations, key=lambda name: not store.observations[name].is_image)
    strips = {name: _strip(store, name, rows) for name in pictures_first}
    captions = [_caption(store, int(row), last=int(time) == length - 1) for row, time in zip(rows, times, strict=True)]
    caption_lines = max(len(caption) for caption in captions)
    label = 18 if len(strips) > 1 else 0
    heights = {name: max(tile.height for tile in tiles) + label + _GAP for name, tiles in strips.items()}
    width = 2 * _MARGIN + len(times) * (_TILE + _GAP) - _GAP
    block = Image.new("RGB", (max(width, 320), 46 + sum(heights.values()) + caption_lines * _LINE + 16), _PAPER)
    pen = ImageDraw.Draw(block)
    pen.line([(_MARGIN, 6), (block.width - _MARGIN, 6)], fill=(214, 218, 226))
    held_out = episode in store.episodes("evaluation")
    title = f"episode {episode}   {length} rows   {'evaluation' if held_out else 'train'}"
    pen.text((_MARGIN, 12), title, fill=_INK, font=_font(14))
    top = 46
    for column, time in enumerate(times):
        pen.text((_left(column), 31), f"t = {time}", fill=_FAINT, font=_font(11))
    for name, tiles in strips.items():
        if label:
            pen.text((_MARGIN, top + 2), name, fill=_INK, font=_font(12))
        for column, tile in enumerate(tiles):
            block.paste(tile, (_left(column) + (_TILE - tile.width) // 2, top + label))
        top += heights[name]
    for column, caption in enumerate(captions):
        for line, text in enumerate(caption):
            pen.text((_left(column), top + line * _LINE), _fit(pen, text), fill=_INK, font=_font(11))
    return block


def _left(column: int) -> int:
    return _MARGIN + column * (_TILE + _GAP)


def _fit(pen: ImageDraw.ImageDraw, text: str) -> str:
    """Cut a text to the width of a tile."""
    while len(text) > 1 and pen.textlength(text, font=_font(11)) > _TILE:
        text = text[:-2] + "…"
    return text


def _strip(store: EpisodeStore, name: str, rows: np.ndarray) -> list[Image.Image]:
    frames = store.gather(f"observations/{name}", rows)
    is_image = store.observations[name].is_image
    return [_picture(frame) if is_image else _extremes(frame) for frame in frames]


def _picture(frame: np.ndarray) -> Image.Image:
    """(C, H, W) uint8 -> a tile; pixels stay sharp where they grow by a whole factor."""
    shown = frame if len(frame) in (1, 3) else frame[-3:] if len(frame) > 3 else frame[:1]
    pixels = np.repeat(shown, 3, axis=0) if len(shown) == 1 else shown
    image = Image.fromarray(np.ascontiguousarray(pixels.transpose(1, 2, 0)))
    longest = max(image.size)
    size = (max(1, image.width * _TILE // longest), max(1, image.height * _TILE // longest))
    return image.resize(size, Image.Resampling.NEAREST if _TILE % longest == 0 else Image.Resampling.LANCZOS)


def _extremes(values: np.ndarray) -> Image.Image:
    tile = Image.new("RGB", (_TILE, 44), _PANEL)
    pen = ImageDraw.Draw(tile)
    pen.text((8, 6), f"max {short_number(values.max())}", fill=_INK, font=_font(12))
    pen.text((8, 23), f"min {short_number(values.min())}", fill=_INK, font=_font(12))
    return tile


def _caption(store: EpisodeStore, row: int, *, last: bool) -> list[str]:
    """Lines below a frame: the action taken at it, and its factors, the agent's own first."""
    lines = []
    if store.actions_spec is not None:
        lines.append("action  none (last)" if last else f"action  {_value(store, 'actions', row)}")
    names = sorted(store.factors, key=lambda name: (store.factors[name].kind, name))
    lines += [f"{name}  {_value(store, f'factors/{name}', row)}" for name in names[:_MOST_FACTORS]]
    if len(names) > _MOST_FACTORS:
        lines.append(f"and {len(names) - _MOST_FACTORS} more")
    return lines


def _value(store: EpisodeStore, key: str, row: int) -> str:
    value = np.atleast_1d(store.gather(key, np.array([row]))[0])
    return short_number(value[0]) if len(value) == 1 else " ".join(f"{number:.2g}" for number in value)
