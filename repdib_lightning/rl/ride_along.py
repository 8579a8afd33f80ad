"""Adds the gradient of a further loss at a tensor, whatever loss is computed from that tensor later."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor


class _RideAlong(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, tensor: Tensor, loss: Tensor) -> Tensor:
        ctx.like = loss
        return tensor.view_as(tensor)

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, Tensor]:  # type: ignore[override]
        return gradient, torch.ones_like(ctx.like)


def ride_along(tensor: Tensor, loss: Tensor) -> Tensor:
    """Return the tensor unchanged; a backward pass through it also runs back from ``loss``, once, with weight 1.

    So an agent of any library trains an encoder with the bottleneck's own losses, without a change of its update.

    Args:
        tensor: (..., M), what the agent goes on with.
        loss: scalar.
    """
    if not (torch.is_grad_enabled() and loss.requires_grad):
        return tensor
    joined: Tensor = _RideAlong.apply(tensor, loss)
    return joined
