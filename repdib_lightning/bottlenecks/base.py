"""The contract of a bottleneck: the slot between an encoder and an objective."""

from __future__ import annotations

from torch import Tensor

from repdib_lightning.arguments import RememberedArguments
from repdib_lightning.errors import UserError
from repdib_lightning.records import BottleneckOutput


class Bottleneck(RememberedArguments):
    """Maps (N, M) to a :class:`BottleneckOutput` of the same width.

    Subclasses are built as ``Bottleneck(width, *, ...)``. In training mode a forward pass may draw noise and update
    buffers (running codebooks); in evaluation mode it is deterministic and changes no buffer. The latent has the
    input's dtype; everything inside is computed in float32 or wider, under autocast too.

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

    @property
    def ready(self) -> bool:
        """Whether evaluation already gives what it will give after training (a quantiser may start late)."""
        return True

    def require_ready(self) -> None:
        """Raise UserError, with what to do about it, unless :attr:`ready`. For those who export or read codes."""

    def forward(self, latent: Tensor) -> BottleneckOutput:
        """Pass (N, M) float through the bottleneck."""
        raise NotImplementedError

    def decode(self, codes: Tensor) -> Tensor:
        """Map (N, G) int64 indices to the (N, M) latent that they stand for. Only where something is quantised."""
        raise UserError(f"{type(self).__name__}: has no codes to decode")

    def check_input(self, latent: Tensor) -> None:
        """Raise UserError unless ``latent`` is (N, M)."""
        if latent.ndim != 2 or latent.shape[1] != self.width:
            raise UserError(f"{type(self).__name__}: takes (N, {self.width}), was given {tuple(latent.shape)}")
