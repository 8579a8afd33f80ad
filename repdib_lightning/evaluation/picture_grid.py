"""Grids of pictures with a label for each line, as PNG bytes."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from matplotlib.figure import Figure

from repdib_lightning.evaluation.figures import png

_GAP = 2
_TALLEST = 400.0
"""Inches; from 596 on, a picture file has more pixels than can be drawn."""
_LETTER = 0.08
"""Inches, of a label."""


def picture_lines(lines: Mapping[str, np.ndarray], title: str, inch: float = 0.62) -> bytes:
    """One line of pictures a label, all of one size.

    Args:
        lines: label -> (n, 3 or 1, H, W) uint8; shorter lines end early.
        title: says what to look for.
        inch: width of a picture; less where the figure would grow too tall or wide to be drawn.
    """
    height, width = next(iter(lines.values())).shape[2:]
    count = max(map(len, lines.values()))
    tall, wide = height + _GAP, width + _GAP
    canvas = np.full((len(lines) * tall - _GAP, count * wide - _GAP, 3), 255, np.uint8)
    for row, pictures in enumerate(lines.values()):
        for column, picture in enumerate(pictures):
            top, left = row * tall, column * wide
            canvas[top : top + height, left : left + width] = picture.transpose(1, 2, 0)
    scale = min(inch / width, _TALLEST / max(len(lines) * tall, count * wide))
    left = 0.2 + _LETTER * max(len(part) for label in lines for part in label.splitlines())
    across, down = count * wide * scale, len(lines) * tall * scale
    size = (left + across + 0.1, 0.4 + down + 0.1)
    figure = Figure(figsize=size)
    axis = figure.add_axes((left / size[0], 0.1 / size[1], across / size[0], down / size[1]))
    axis.imshow(canvas, interpolation="nearest")
    axis.set_yticks([row * tall + height / 2 for row in range(len(lines))], list(lines), fontsize=9)
    axis.set_xticks([])
    axis.tick_params(length=0)
    axis.spines[:].set_visible(False)
    figure.suptitle(title, fontsize=11, y=1.0 - 0.1 / size[1], va="top")
    return png(figure)
