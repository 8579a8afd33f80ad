"""Which steps of a clip were observed, and what stands in for those that were not: zeros."""

from __future__ import annotations

import torch
from torch import Tensor


def observed_frames(video: Tensor) -> Tensor:
    """Steps of (N, T, C, H, W) uint8 with anything but zeros: (N, T) bool."""
    return video.flatten(2).amax(-1) > 0


def observed_readings(readings: Tensor) -> Tensor:
    """Steps of (N, T, X) at which any channel is a finite number: (N, T) bool."""
    return readings.isfinite().any(-1)


def finite_only(readings: Tensor) -> Tensor:
    """The readings with zeros for what is no finite number."""
    return torch.where(readings.isfinite(), readings, 0.0)


def zero_unobserved(vectors: Tensor, observed: Tensor) -> Tensor:
    """(..., d) with zeros where ``observed`` (...) is False; no gradient passes there."""
    return vectors.masked_fill(~observed.unsqueeze(-1), 0.0)


def masked_shares(scores: Tensor, observed: Tensor) -> Tensor:
    """Softmax over the last axis of what was observed, 0 for the rest, and for all where nothing was."""
    floor = torch.finfo(scores.dtype).min  # of -inf alone, a softmax is NaN
    return scores.masked_fill(~observed, floor).softmax(-1).masked_fill(~observed, 0.0)
