"""Pictures of one shape on a pale ground, drawn from seven factors and nothing else.

All coordinates are fractions of the picture's width, x to the right and y downwards.
"""

from __future__ import annotations

import colorsys
import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

_HUES = tuple(45 * step for step in range(8))  # degrees
_PLACES = tuple((4.5 + step) / 16 for step in range(8))  # whole pixels apart where the size divides by 16

LEVELS: dict[str, tuple[str, ...] | tuple[float, ...]] = {
    "shape": ("square", "disc", "triangle", "star"),
    "hue": _HUES,
    "size": (0.13, 0.18, 0.23, 0.28),
    "horizontal": _PLACES,
    "vertical": _PLACES,
    "brightness": (0.35, 0.55, 0.75, 0.95),
    "background": _HUES,
}
"""Factor -> what each of its levels stands for.

``hue`` and ``background`` are degrees on the colour circle, of the shape and of the pale ground; ``size`` is the square
root of the shape's area, the same for all shapes; ``horizontal`` and ``vertical`` place its centroid; ``brightness`` is
the shape's value in HSV.
"""

SUBPIXELS = 4
"""Samples along each edge of a pixel."""

SHAPE_SATURATION, GROUND_SATURATION = 0.9, 0.28
"""In HSV; the ground's value is 1."""


@dataclass(frozen=True)
class _Outline:
    """A shape of area 1 around its centroid: the points that at least ``needed`` of the half-planes hold.

    A half-plane holds the points whose part along its normal is at most ``distance``; a five-pointed star is where its
    five lines agree but for one.
    """

    normals: tuple[int, ...]  # degrees, clockwise from the right since y points down
    distance: float
    needed: int
    reach: float  # from the centroid to the farthest corner


def _regular(corners: int, first_normal: int) -> _Outline:
    distance = math.sqrt(1 / (corners * math.tan(math.pi / corners)))
    normals = tuple(first_normal + 360 * side // corners for side in range(corners))
    return _Outline(normals, distance, corners, distance / math.cos(math.pi / corners))


def _five_pointed_star() -> _Outline:
    inner = math.cos(math.radians(72)) / math.cos(math.radians(36))  # radius of the notches, where the corners' is 1
    reach = math.sqrt(1 / (5 * inner * math.sin(math.radians(36))))
    normals = tuple(-90 + 72 * corner for corner in range(5))
    return _Outline(normals, reach * math.cos(math.radians(72)), 4, reach)


_OUTLINES = {"square": _regular(4, 0), "triangle": _regular(3, 90), "star": _five_pointed_star()}
_DISC_RADIUS = math.sqrt(1 / math.pi)


def draw_shape(levels: Mapping[str, int], size: int) -> np.ndarray:
    """Draw one picture.

    Edges are smoothed: a pixel mixes the two colours by how many of its 4 x 4 samples lie in the shape.

    Args:
        levels: factor -> index in its :data:`LEVELS`, for every factor.
        size: H and W in pixels.

    Returns:
        (3, H, W) uint8.
    """
    assert levels.keys() == LEVELS.keys(), f"factors are {sorted(LEVELS)}, not {sorted(levels)}"
    chosen = {name: LEVELS[name][level] for name, level in levels.items()}
    ground = _rgb(float(chosen["background"]), GROUND_SATURATION, 1.0)
    colour = _rgb(float(chosen["hue"]), SHAPE_SATURATION, float(chosen["brightness"]))
    picture = np.empty((3, size, size), np.uint8)
    picture[:] = ground[:, None, None]
    centre = float(chosen["horizontal"]), float(chosen["vertical"])
    columns, rows, covered = _coverage(str(chosen["shape"]), float(chosen["size"]), centre, size)
    samples = SUBPIXELS**2
    mixed = ground[:, None, None] * (samples - covered) + colour[:, None, None] * covered
    picture[:, rows, columns] = (mixed + samples // 2) // samples  # whole numbers, so that no machine rounds otherwise
    return picture


def _rgb(hue: float, saturation: float, value: float) -> np.ndarray:
    """(3,) int64, 0 to 255; hue in degrees."""
    return np.array([round(255 * part) for part in colorsys.hsv_to_rgb(hue / 360, saturation, value)])


def _coverage(shape: str, side: float, centre: tuple[float, float], size: int) -> tuple[slice, slice, np.ndarray]:
    """Columns and rows of the pixels that a shape may touch, and how many samples of each lie in it: (h, w) int64."""
    reach = side * (_DISC_RADIUS if shape == "disc" else _OUTLINES[shape].reach)
    spans = [slice(math.floor((at - reach) * size), math.ceil((at + reach) * size)) for at in centre]
    assert all(span.start >= 0 and span.stop <= size for span in spans), "a shape leaves the picture"
    x, y = (
        ((np.arange(span.start * SUBPIXELS, span.stop * SUBPIXELS) + 0.5) / (size * SUBPIXELS) - at) / side
        for span, at in zip(spans, centre, strict=True)
    )
    inside = _inside(shape, x[None, :], y[:, None])
    blocks = inside.reshape(len(y) // SUBPIXELS, SUBPIXELS, len(x) // SUBPIXELS, SUBPIXELS)
    return spans[0], spans[1], blocks.sum(axis=(1, 3))


def _inside(shape: str, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Which points lie in the shape of area 1: (1, w) and (h, 1) -> (h, w) bool."""
    if shape == "disc":
        return x**2 + y**2 <= _DISC_RADIUS**2
    outline = _OUTLINES[shape]
    agreeing = np.zeros(np.broadcast_shapes(x.shape, y.shape), np.int8)
    for normal in map(math.radians, outline.normals):
        agreeing += math.cos(normal) * x + math.sin(normal) * y <= outline.distance
    return agreeing >= outline.needed
