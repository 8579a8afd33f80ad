"""Readings over time as coloured lines, with gaps where nothing was observed."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import numpy as np
from PIL import Image, ImageDraw

from repdib_lightning.data.frame_columns import FAINT, PANEL, PAPER, font
from repdib_lightning.data.inspection_text import short_number

COLOURS = ((31, 119, 180), (214, 96, 20), (44, 140, 60), (190, 40, 60), (128, 90, 180), (110, 75, 60))
"""Of the lines; of more channels than these only the first are drawn."""

_SCALE, _LEGEND = 2, 136


def draw_traces(values: np.ndarray, names: Sequence[str], size: tuple[int, int]) -> Image.Image:
    """Draw one line for each channel, all on one scale, whose ends are written beside them.

    Args:
        values: (T, X) float32; what is not finite is left open.
        names: X, of the channels.
        size: width and height in pixels.
    """
    width, height = size
    shown = values[:, : len(COLOURS)]
    finite = shown[np.isfinite(shown)]
    low, high = (float(finite.min()), float(finite.max())) if finite.size else (0.0, 0.0)
    image = Image.new("RGB", size, PAPER)
    image.paste(_lines(shown, low, high, width - _LEGEND, height), (0, 0))
    pen = ImageDraw.Draw(image)
    left = width - _LEGEND + 6
    pen.text((left, 0), short_number(high), fill=FAINT, font=font(10))
    pen.text((left, height - 12), short_number(low), fill=FAINT, font=font(10))
    step = min(13, (height - 4) // max(1, shown.shape[1]))
    for place, (name, colour) in enumerate(zip(names, COLOURS, strict=False)):
        there = np.isfinite(shown[:, place]).any()
        pen.text((left + 42, place * step), name[:15], fill=colour if there else FAINT, font=font(10))
    if len(names) > len(COLOURS):
        pen.text((8, 2), f"the first {len(COLOURS)} of {len(names)} channels", fill=FAINT, font=font(10))
    return image


def _lines(values: np.ndarray, low: float, high: float, width: int, height: int) -> Image.Image:
    """Drawn larger and reduced, so that they are smooth."""
    panel = Image.new("RGB", (width * _SCALE, height * _SCALE), PANEL)
    pen = ImageDraw.Draw(panel)
    across = np.linspace(0, panel.width - 1, len(values)) if len(values) > 1 else np.array([panel.width / 2])
    margin = 4 * _SCALE
    up = (values - low) / (high - low) if high > low else np.full(values.shape, 0.5)
    down = margin + (1 - up) * (panel.height - 1 - 2 * margin)
    for channel, colour in enumerate(COLOURS[: values.shape[1]]):
        there = np.isfinite(values[:, channel])
        points = list(zip(across.tolist(), down[:, channel].tolist(), strict=True))
        for step in np.flatnonzero(there):
            x, y = points[step]
            pen.point((x, y), fill=colour)
        for (first, here), (second, following) in pairwise(zip(points, there, strict=True)):
            if here and following:
                pen.line([first, second], fill=colour, width=_SCALE + 1)
    return panel.reduce(_SCALE)
