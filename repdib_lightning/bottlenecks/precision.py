"""Computing in float32 whatever the precision of the network around."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Self

import torch
from torch import Tensor, nn


def at_least_single(dtype: torch.dtype) -> torch.dtype:
    """Return float32 for the half precisions, and the wider types as they are."""
    return torch.promote_types(dtype, torch.float32)


def without_autocast(tensor: Tensor) -> torch.autocast:
    """Return a context that switches autocast off on the tensor's own kind of device."""
    return torch.autocast(device_type=tensor.device.type, enabled=False)


class SinglePrecision(nn.Module):
    """A module whose own tensors stay float32 under ``.half()`` and ``.to(torch.bfloat16)``; it still moves devices.

    Running averages lose small updates in half precision: with a decay of 0.99 a bfloat16 average cannot move by less
    than 0.4 %.
    """

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> Self:
        def keeping_precision(tensor: Tensor) -> Tensor:
            applied = fn(tensor)
            narrowed = tensor.is_floating_point() and applied.dtype != at_least_single(applied.dtype)
            return tensor.to(applied.device) if narrowed else applied

        applied: Any = super()._apply(keeping_precision, recurse)
        assert applied is self
        return self
