"""What moves in a clip: how its frames differ from their mean."""

from __future__ import annotations

import torch
from torch import Tensor

from repdib_lightning.errors import UserError, nearest

FRAME_INPUTS = ("frames", "differences", "both")


def check_frame_input(chosen: str) -> None:
    """Raise UserError unless this is one of ``FRAME_INPUTS``."""
    if chosen not in FRAME_INPUTS:
        raise UserError(f"MultimodalEncoder: unknown frame_input '{chosen}', {nearest(chosen, FRAME_INPUTS)}")


def input_channels(chosen: str, channels: int) -> int:
    """Channels of what the network of a frame sees."""
    return 2 * channels if chosen == "both" else channels


def frame_input(frames: Tensor, observed: Tensor, chosen: str) -> Tensor:
    """The frames, how they differ from the mean of the clip's observed frames, or both as channels.

    Before a camera that stands still the difference is what moves. It is kept as pictures are: 127.5 + difference / 2.

    Args:
        frames: (N, T, C, H, W) uint8.
        observed: (N, T) bool.
        chosen: one of ``FRAME_INPUTS``.

    Returns:
        (N, T, C or 2 C, H, W) uint8.
    """
    if chosen == "frames":
        return frames
    there = observed[:, :, None, None, None]
    count = there.sum(1, keepdim=True).clamp_min(1)
    mean = (frames * there).sum(1, keepdim=True, dtype=torch.float32) / count  # what is missing is zeros, or to be
    differences = torch.sub(frames, mean).mul_(0.5).add_(127.5).to(torch.uint8)
    return differences if chosen == "differences" else torch.cat([frames, differences], dim=2)
