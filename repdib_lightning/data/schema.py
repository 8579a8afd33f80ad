"""The store's schema: one HDF5 file, flat contiguous arrays, one row a time step.

::

    /observations/<name>   (N, ...)  uint8 or float32, never frame-stacked
    /actions               (N,) int64, or (N, A) float32       the action taken AT the row's observation
    /rewards               (N,) float32                        optional
    /terminations          (N,) bool, /truncations (N,) bool   optional: that action ended the episode
    /episodes/start        (E,) int64, /episodes/length (E,) int64
    /episodes/evaluation   (E,) bool                           optional: never trained on
    /episodes/recording    (E,) int64                          optional: episodes that nothing may split share one
    /factors/<name>        (N, ...)  ground truth, attributes kind, scale (and classes)
    /masks/<observation>   (N, H, ceil(W / 8)) uint8           optional: bit-packed pixels of the agent

A clip is an episode of one row: a video is (N, T, C, H, W) uint8, readings of a sensor are (N, T, X) float32. What is
missing of it, or lies beyond its end, is frames of zeros only, and NaN; a frame that was seen is never all zeros.

An episode's last row holds the final observation and no action: -1 (discrete) or 0 (continuous), never sampled.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

FORMAT = "repdib_episodes"
SCHEMA_VERSION = 1


@dataclass(frozen=True)
class FactorSpec:
    """A ground-truth factor of the picture.

    ``kind`` says whether the agent's state depends on it; ``scale`` how it is probed: ``categorical`` factors are
    integers in [0, classes), ``continuous`` ones are real numbers (or vectors).
    """

    kind: Literal["endogenous", "exogenous"]
    scale: Literal["categorical", "continuous"]
    classes: int = 0
    width: int = 1
