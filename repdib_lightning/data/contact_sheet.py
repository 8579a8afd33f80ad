"""A picture of a store: a few episodes as rows of frames over time; of a store of single pictures, a grid of them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw

from repdib_lightning.data.clip_picture import draw_clip
from repdib_lightning.data.clips import holds_clips
from repdib_lightning.data.episodes import EpisodeStore
from repdib_lightning.data.files import whole_file
from repdib_lightning.data.frame_captions import captions
from repdib_lightning.data.frame_columns import FAINT, INK, MARGIN, PAPER, draw_columns, font, width_of

_COLUMNS, _EPISODES, _GRID_ROWS = 8, 4, 4
_HEAD = 64


def draw_contact_sheet(store: EpisodeStore, path: Path) -> Path:
    """Write a PNG of frames with their factors, by the names of their classes where the store has them.

    Four episodes spread over the store, each with eight frames spread over it, first and last row included, and the
    actions taken at them. Where every episode has one row, 32 of them, spread over the store; where that row is a clip,
    four of them, each with eight frames of every view and the readings of its sensors.

    Raises:
        UserError: the PNG cannot be written.
    """
    if (store.lengths == 1).all():
        summary, blocks = _clips(store) if holds_clips(store) else _pictures(store)
    else:
        summary, blocks = _episodes(store)
    width = max(width_of(_COLUMNS), *(block.width for block in blocks))
    sheet = Image.new("RGB", (width, _HEAD + sum(block.height for block in blocks)), PAPER)
    pen = ImageDraw.Draw(sheet)
    pen.text((MARGIN, 14), store.path.name, fill=INK, font=font(20))
    pen.text((MARGIN, 40), summary, fill=FAINT, font=font(13))
    top = _HEAD
    for block in blocks:
        sheet.paste(block, (0, top))
        top += block.height
    with whole_file(path) as temporary:
        sheet.save(temporary, format="PNG")
    return path


def _spread(count: int, wanted: int) -> np.ndarray:
    """At most ``wanted`` of the numbers below ``count``, evenly spread, the first and the last among them."""
    return np.unique(np.linspace(0, count - 1, wanted).round().astype(np.int64))


def _split_of(store: EpisodeStore, episodes: np.ndarray) -> list[str]:
    held_out = np.isin(episodes, store.episodes("evaluation"))
    return ["evaluation" if held else "train" for held in held_out]


def _pictures(store: EpisodeStore) -> tuple[str, list[Image.Image]]:
    count = len(store.lengths)
    chosen = _spread(count, _COLUMNS * _GRID_ROWS)
    blocks = []
    for first in range(0, len(chosen), _COLUMNS):
        episodes = chosen[first : first + _COLUMNS]
        rows = store.starts[episodes]
        splits = _split_of(store, episodes)
        headings = [f"row {row}   {split}" for row, split in zip(rows, splits, strict=True)]
        blocks.append(draw_columns(store, rows, headings, captions(store, rows, actions=False)))
    noun = "pictures" if any(spec.is_image for spec in store.observations.values()) else "rows"
    return f"{count:,} {noun}; {'all' if len(chosen) == count else len(chosen)} of them", blocks


def _clips(store: EpisodeStore) -> tuple[str, list[Image.Image]]:
    count = len(store.lengths)
    chosen = _spread(count, _EPISODES)
    splits = _split_of(store, chosen)
    blocks = [draw_clip(store, int(clip), split, _COLUMNS) for clip, split in zip(chosen, splits, strict=True)]
    return f"{count:,} clips; {'all' if len(chosen) == count else len(chosen)} of them", blocks


def _episodes(store: EpisodeStore) -> tuple[str, list[Image.Image]]:
    chosen = _spread(len(store.lengths), _EPISODES)
    blocks = [
        _episode(store, int(episode), split) for episode, split in zip(chosen, _split_of(store, chosen), strict=True)
    ]
    return f"{store.rows:,} rows in {len(store.lengths):,} episodes; {len(blocks)} of them, over time", blocks


def _episode(store: EpisodeStore, episode: int, split: str) -> Image.Image:
    length = int(store.lengths[episode])
    times = _spread(length, _COLUMNS)
    rows = store.starts[episode] + times
    columns = draw_columns(store, rows, [f"t = {time}" for time in times], captions(store, rows, actions=True))
    title_height = 31
    block = Image.new("RGB", (max(columns.width, 320), title_height + columns.height), PAPER)
    block.paste(columns, (0, title_height))
    pen = ImageDraw.Draw(block)
    pen.line([(MARGIN, 6), (block.width - MARGIN, 6)], fill=(214, 218, 226))
    title = f"episode {episode}   {length} {'row' if length == 1 else 'rows'}   {split}"
    pen.text((MARGIN, 12), title, fill=INK, font=font(14))
    return block
