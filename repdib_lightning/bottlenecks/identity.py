"""No bottleneck: the baseline every other one is compared with."""

from __future__ import annotations

from torch import Tensor

from repdib_lightning.bottlenecks.base import Bottleneck
from repdib_lightning.records import BottleneckOutput


class Identity(Bottleneck):
    """Returns the encoder's output unchanged ("none" in the paper's tables).

    Args:
        width: M.
    """

    def __init__(self, width: int) -> None:
        super().__init__(width)

    def forward(self, latent: Tensor) -> BottleneckOutput:
        """Return (N, M) as it is."""
        return BottleneckOutput(latent)
