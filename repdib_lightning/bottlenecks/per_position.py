"""One bottleneck for every position of a grid."""

from __future__ import annotations

from collections.abc import Callable

from torch import Tensor

from repdib_lightning.bottlenecks.base import Bottleneck
from repdib_lightning.records import BottleneckOutput


class PerPosition(Bottleneck):
    """Takes the P vectors of (N, P * m) one by one through a bottleneck of width m, the same for all.

    Its ``groups`` are P * G, position by position: code (p, g) stands at p * G + g.

    Args:
        inner: of width m.
        positions: P.
    """

    def __init__(self, inner: Bottleneck, positions: int) -> None:
        super().__init__(inner.width * positions)
        self.inner, self.positions = inner, positions
        self.groups, self.codes = inner.groups * positions, inner.codes

    @property
    def ready(self) -> bool:
        """Whether the inner one is."""
        return self.inner.ready

    def require_ready(self) -> None:
        """Raise UserError unless the inner one is ready."""
        self.inner.require_ready()

    def forward(self, latent: Tensor) -> BottleneckOutput:
        """Pass (N, P * m) through, position by position."""
        self.check_input(latent)
        output: BottleneckOutput = self.inner(latent.reshape(-1, self.inner.width))
        codes = None if output.codes is None else output.codes.reshape(-1, self.groups)
        return BottleneckOutput(output.latent.reshape(-1, self.width), output.losses, codes, output.metrics)

    def decode(self, codes: Tensor) -> Tensor:
        """Map (N, P * G) int64 indices to the (N, P * m) latent that they stand for."""
        return self.inner.decode(codes.reshape(-1, self.inner.groups)).reshape(-1, self.width)


def for_positions(build: Callable[[int], Bottleneck], features: int, positions: int) -> Bottleneck:
    """Build a bottleneck for a latent of width M that is a grid of P positions (1: no grid)."""
    return build(features) if positions == 1 else PerPosition(build(features // positions), positions)
