"""Random shifts: the augmentation of DrQ (Kostrikov et al. 2020; Yarats et al. 2021)."""

from __future__ import annotations

import torch
from torch import Tensor

from repdib_lightning.processes import own_rows, rows_of_all


def random_shift(image: Tensor, pad: int) -> Tensor:
    """Move each picture by up to ``pad`` pixels in both directions; the border is repeated outwards.

    Args:
        image: (N, C, H, W) of any dtype, or videos (N, T, C, H, W).
        pad: largest shift in pixels; 0 returns the input.

    Returns:
        Of the same shape, every picture with a shift of its own, every video with one for all its frames, drawn from
        torch's global generator.
    """
    if pad == 0:
        return image
    if image.ndim == 5:
        return random_shift(image.flatten(1, 2), pad).unflatten(1, image.shape[1:3])
    count, _, height, width = image.shape
    shift = own_rows(torch.randint(-pad, pad + 1, (2, rows_of_all(count), 1), device=image.device), dim=1)
    rows = (torch.arange(height, device=image.device) + shift[0]).clamp_(0, height - 1)
    columns = (torch.arange(width, device=image.device) + shift[1]).clamp_(0, width - 1)
    pictures = torch.arange(count, device=image.device)[:, None, None]
    # Indices on both sides of the channel axis put it last: (N, H, W, C), seen again as (N, C, H, W).
    return image[pictures, :, rows[:, :, None], columns[:, None, :]].movedim(-1, 1)
