"""The contract of a decoder."""

from __future__ import annotations

from dataclasses import replace

from torch import Tensor

from repdib_lightning.arguments import RememberedArguments
from repdib_lightning.records import DataSpec


class Decoder(RememberedArguments):
    """Draws a picture from a latent.

    Subclasses are built as ``Decoder(spec, width, *, ...)``; sizes are measured from the spec.

    Attributes:
        spec: of the data, with the one picture that is drawn.
        width: M.
        view: name of the picture.
    """

    supplied = 2

    def __init__(self, spec: DataSpec, width: int, view: str) -> None:
        super().__init__()
        self.spec = replace(spec, observations={view: spec.observations[view]})
        self.width, self.view = width, view

    def forward(self, latents: Tensor) -> Tensor:
        """Draw (N, M) as (N, S * C, H, W) float, 0 (black) to 1."""
        raise NotImplementedError
