"""The contract of a self-supervised objective."""

from __future__ import annotations

from collections.abc import Callable

from torch import Tensor, nn

from repdib_lightning.records import Batch, ObjectiveOutput

Encode = Callable[[dict[str, Tensor]], Tensor]
"""Observations name -> (B, F, *shape) to latents (B, F, M), in ONE pass of encoder and bottleneck."""


class Objective(nn.Module):
    """Turns a batch into named losses. Subclasses are built as ``Objective(width, spec, *, ...)``.

    Class attributes say what the data must offer; the data module draws the samples accordingly.
    """

    needs_actions: bool = False

    def forward(self, batch: Batch, encode: Encode) -> ObjectiveOutput:
        """Encode what is needed with one call of ``encode``, and return unweighted losses."""
        raise NotImplementedError
