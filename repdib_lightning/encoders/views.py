"""Turns the pictures of a batch into what convolutions take."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor, nn

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
            raise UserError(f"{owner}: views has '{name}', which is no picture in the data, {nearest(name, images)}")
    chosen = views if views is not None else images
    if not chosen:
        raise UserError(f"{owner}: needs at least one picture (C, H, W); pictures in the data: {images or 'none'}")
    for name in chosen:
        if "." in name or hasattr(nn.ModuleDict, name):
            raise UserError(f"{owner}: an observation cannot be called '{name}'; rename it in the data")
    return list(chosen)


def seen_only(spec: DataSpec, views: list[str]) -> DataSpec:
    """The spec of an encoder that uses some of the observations: what a bundle will ask for."""
    return replace(spec, observations={name: spec.observations[name] for name in views})


def centred(image: Tensor) -> Tensor:
    """Scale uint8 [0, 255] to float [-0.5, 0.5] (DrQ-v2's range): (N, C, H, W) -> (N, C, H, W).

    The result lies in memory as (N, H, W, C), the order in which convolutions are fastest on a CPU, and in which
    :func:`~repdib_lightning.encoders.augmentation.random_shift` leaves it anyway.
    """
    return image.to(torch.get_default_dtype(), copy=True, memory_format=torch.channels_last).div_(255.0).sub_(0.5)
