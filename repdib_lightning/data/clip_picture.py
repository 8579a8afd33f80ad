"""A clip as a picture: frames of every view side by side, the readings of its sensors beneath."""

from __future__ import annotations

import numpy as np
from PIL import Image, ImageDraw

from repdib_lightning.data.clips import is_clip
from repdib_lightning.data.episodes import EpisodeStore
from repdib_lightning.data.frame_captions import captions, channel_names, rate_of
from repdib_lightning.data.frame_columns import (
    FAINT,
    GAP,
    INK,
    MARGIN,
    PANEL,
    PAPER,
    TILE,
    font,
    left_of,
    picture_tile,
    tiles_of,
    width_of,
)
from repdib_lightning.data.traces import draw_traces

_TITLE, _LABEL, _TRACES, _NOTHING = 54, 18, 84, 30


def draw_clip(store: EpisodeStore, clip: int, split: str, columns: int) -> Image.Image:
    """Draw the clip of one row, with its factors by the names of their classes.

    Args:
        store: where the clip lives.
        clip: row.
        split: what is written beside its number.
        columns: how many frames of each view, spread over those that were observed.
    """
    videos = [name for name, spec in store.observations.items() if spec.is_video]
    sequences = [name for name, spec in store.observations.items() if spec.is_sequence]
    others = [name for name in store.observations if not is_clip(store, name)]
    width = width_of(columns)
    strips = [_frames(store, name, clip, columns) for name in videos]
    strips += [_readings(store, name, clip, width) for name in sequences]
    strips += [_still(store, name, clip, width) for name in others]
    block = Image.new("RGB", (width, _TITLE + sum(strip.height for strip in strips) + GAP), PAPER)
    pen = ImageDraw.Draw(block)
    pen.line([(MARGIN, 6), (block.width - MARGIN, 6)], fill=(214, 218, 226))
    pen.text((MARGIN, 12), f"clip {clip}   {split}", fill=INK, font=font(14))
    (factors,) = captions(store, np.array([clip]), actions=False)
    pen.text((MARGIN, 33), "     ".join(factors), fill=INK, font=font(12))
    top = _TITLE
    for strip in strips:
        block.paste(strip, (0, top))
        top += strip.height
    return block


def _strip(name: str, height: int, width: int, note: str = "") -> tuple[Image.Image, ImageDraw.ImageDraw]:
    """White paper of some height below the name of an observation."""
    strip = Image.new("RGB", (width, _LABEL + height + GAP), PAPER)
    pen = ImageDraw.Draw(strip)
    pen.text((MARGIN, 1), name, fill=INK, font=font(12))
    pen.text((MARGIN + pen.textlength(name, font=font(12)) + 12, 2), note, fill=FAINT, font=font(11))
    return strip, pen


def _frames(store: EpisodeStore, name: str, clip: int, columns: int) -> Image.Image:
    video = store.gather(f"observations/{name}", np.array([clip]))[0]
    observed, width = np.flatnonzero(video.any(axis=(1, 2, 3))), width_of(columns)
    if not len(observed):
        return _missing(name, width)
    shown = observed[np.unique(np.linspace(0, len(observed) - 1, columns).round().astype(np.int64))]
    tiles = [picture_tile(video[frame]) for frame in shown]
    note = f"{len(observed)} of {len(video)} frames; here {', '.join(map(str, shown))}"
    strip, _ = _strip(name, max(tile.height for tile in tiles), width, note)
    for column, tile in enumerate(tiles):
        strip.paste(tile, (left_of(column) + (TILE - tile.width) // 2, _LABEL))
    return strip


def _missing(name: str, width: int) -> Image.Image:
    strip, pen = _strip(name, _NOTHING, width)
    pen.rectangle([MARGIN, _LABEL, width - MARGIN - 1, _LABEL + _NOTHING - 1], fill=PANEL)
    pen.text((MARGIN + 10, _LABEL + 8), "missing", fill=FAINT, font=font(12))
    return strip


def _readings(store: EpisodeStore, name: str, clip: int, width: int) -> Image.Image:
    values = store.gather(f"observations/{name}", np.array([clip]))[0]
    if not np.isfinite(values).any():
        return _missing(name, width)
    rate = rate_of(store, name)
    length = f"{len(values)} steps" if rate is None else f"{len(values) / rate:.3g} s"
    strip, _ = _strip(name, _TRACES, width, length)
    traces = draw_traces(values, channel_names(store, name), (width - 2 * MARGIN, _TRACES))
    strip.paste(traces, (MARGIN, _LABEL))
    return strip


def _still(store: EpisodeStore, name: str, clip: int, width: int) -> Image.Image:
    """What has no steps, such as one picture of the room."""
    (tile,) = tiles_of(store, name, np.array([clip]))
    strip, _ = _strip(name, tile.height, width)
    strip.paste(tile, (MARGIN, _LABEL))
    return strip
