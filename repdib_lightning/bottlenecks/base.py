"""The contract of a bottleneck: the slot between an encoder and an objective."""

from __future__ import annotations

from torch import Tensor

from repdib_lightning.arguments import RememberedArguments
from repdib_lightning.errors import UserError
from repdib_lightning.records import BottleneckOutput


class Bottleneck(RememberedArguments):
    """Maps (N, M) to a :class:`BottleneckOutput` of the same width.

    Subclasses are built as ``Bottleneck(width, *, ...)``. In training mode a forward pass may draw noise and update
    buffers (running codebooks); in evaluation mode it is deterministic and changes no buffer.

    Attributes:
        width: M.
        groups: G, or 0 where nothing is quantised.
        codes: L, or 0 where nothing is quantised.
    """

    groups: int = 0
    codes: int = 0

    def __init__(self, width: int) -> None:
        super().__init__()
        if width < 1:
            raise UserError(f"{type(self).__name__}: width must be at least 1, is {width}")
        self.width = width

    def forward(self, latent: Tensor) -> BottleneckOutput:
        """Pass (N, M) float through the bottleneck."""
        raise NotImplementedError

    def decode(self, codes: Tensor) -> Tensor:
        """Map (N, G) int64 indices to the (N, M) latent that they stand for. Only where something is quantised."""
        raise UserError(f"{type(self).__name__}: has no codes to decode")
