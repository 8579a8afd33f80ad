"""Turns the pictures of a batch into what convolutions take."""

from __future__ import annotations

import torch
from torch import Tensor

from repdib_lightning.errors import UserError, nearest
from repdib_lightning.records import DataSpec


def image_views(spec: DataSpec, views: list[str] | None, owner: str) -> list[str]:
    """Names of the pictures an encoder uses: the given ones, or all in the spec.

    Raises:
        UserError: an unknown view, one that is no picture, or none at all.
    """
    images = [name for name, array in spec.observations.items() if array.is_image]
    for name in views or []:
        if name not in images:
            raise UserError(f"{owner}: views has '{name}', which is no picture in the data {nearest(name, images)}")
    chosen = views if views is not None else images
    if not chosen:
        raise UserError(f"{owner}: needs a picture (C, H, W), the data has {sorted(spec.observations)}")
    return list(chosen)


def centred(image: Tensor) -> Tensor:
    """Scale uint8 [0, 255] to float [-0.5, 0.5] (DrQ-v2's range): (N, C, H, W) -> (N, C, H, W)."""
    return image.to(torch.get_default_dtype()).div(255.0).sub(0.5)
