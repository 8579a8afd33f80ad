"""A slowly following copy of encoder and bottleneck."""

from __future__ import annotations

import copy
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Self

import torch
from torch import Tensor, nn

from repdib_lightning.bottlenecks import Bottleneck, VectorQuantiser
from repdib_lightning.bottlenecks.precision import SinglePrecision, at_least_single
from repdib_lightning.bottlenecks.reservoir import Reservoir
from repdib_lightning.encoders.base import Encoder


class TargetNetwork(SinglePrecision):
    """Encoder and bottleneck with weights that are running averages: target <- (1 - rate) target + rate * weights.

    Buffers (running codebooks, statistics) are copied. A quantiser that starts late starts here at the same step, with
    the same codes; the latents that it gathers until then are not copied.

    It is always in evaluation mode, draws no noise and moves no codebook. It gives no gradient, and its weights want
    none. They are float32 or wider whatever the precision around, in which small steps of an average would be lost.

    Args:
        encoder, bottleneck: what is copied, as they are at this moment.
        rate: in (0, 1].
    """

    def __init__(self, encoder: Encoder, bottleneck: Bottleneck, rate: float) -> None:
        super().__init__()
        self.encoder, self.bottleneck = copy.deepcopy(encoder), copy.deepcopy(bottleneck)
        self.rate = rate
        self._apply(lambda tensor: tensor.to(at_least_single(tensor.dtype)) if tensor.is_floating_point() else tensor)
        self.requires_grad_(False)
        self.eval()

    def train(self, mode: bool = True) -> Self:
        """Stay in evaluation mode."""
        return super().train(False)

    @torch.no_grad()
    def forward(self, observations: dict[str, Tensor]) -> Tensor:
        """Latents (N, M) of name -> (N, *shape)."""
        dtype = next(self.parameters()).dtype
        with _default_dtype(dtype):
            seen = {name: rows.to(dtype) if rows.is_floating_point() else rows for name, rows in observations.items()}
            latents: Tensor = self.bottleneck(self.encoder(seen)).latent
        return latents

    @torch.no_grad()
    def follow(self, encoder: Encoder, bottleneck: Bottleneck) -> None:
        """Go a step towards these, which must be what was copied."""
        for mine, followed in ((self.encoder, encoder), (self.bottleneck, bottleneck)):
            averages: list[Tensor] = list(mine.parameters())
            weights = [weight.to(mean.dtype) for mean, weight in zip(averages, followed.parameters(), strict=True)]
            if averages:
                torch._foreach_lerp_(averages, weights, self.rate)
            for part, of_followed in zip(mine.modules(), followed.modules(), strict=True):
                _copy_buffers(part, of_followed)


def _copy_buffers(part: nn.Module, followed: nn.Module) -> None:
    """Those of one module, without its parts."""
    if isinstance(part, Reservoir):
        return
    if isinstance(part, VectorQuantiser) and part.ready != followed.ready:
        part.load_state_dict(followed.state_dict())  # all of it: codes that are weights have just been placed
    for name, buffer in followed.named_buffers(recurse=False):
        part.get_buffer(name).copy_(buffer)


@contextmanager
def _default_dtype(dtype: torch.dtype) -> Iterator[None]:
    """The type in which encoders scale pictures."""
    before = torch.get_default_dtype()
    torch.set_default_dtype(dtype)
    try:
        yield
    finally:
        torch.set_default_dtype(before)
