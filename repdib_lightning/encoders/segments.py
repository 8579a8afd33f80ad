"""Segments of a clip: a few frames that stand for all (Temporal Segment Networks, Wang et al. 2016)."""

from __future__ import annotations

import torch
from torch import Tensor

from repdib_lightning.processes import own_rows, rows_of_all


def segment_frames(clip: Tensor, segments: int, *, training: bool) -> Tensor:
    """Cut the T stored frames into equal parts and take one of each: (N, T, ...) -> (N, segments, ...).

    Part i reaches from floor(i T / segments) to floor((i + 1) T / segments). In training a random frame of it is taken,
    for each clip another; in evaluation the middle one, of an even number the earlier.

    Args:
        clip: (N, T, ...).
        segments: how many; 0, or at least T, takes all frames.
        training: draw from torch's global generator.
    """
    count, stored = clip.shape[:2]
    if not 0 < segments < stored:
        return clip
    bounds = torch.arange(segments + 1, device=clip.device) * stored // segments
    first, after = bounds[:-1], bounds[1:]
    if not training:
        return clip.index_select(1, (first + after - 1) // 2)
    drawn = own_rows(torch.rand(rows_of_all(count), segments, device=clip.device))
    # A float32 just below 1 times a length may round up to the length itself.
    frames = torch.minimum(first + (drawn * (after - first)).long(), after - 1)
    return clip[torch.arange(count, device=clip.device).unsqueeze(1), frames]
