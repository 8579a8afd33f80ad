"""The contract of an encoder."""

from __future__ import annotations

from torch import Tensor

from repdib_lightning.arguments import RememberedArguments
from repdib_lightning.errors import UserError
from repdib_lightning.records import DataSpec


class Encoder(RememberedArguments):
    """Maps a dictionary of observations to one vector.

    Subclasses are built as ``Encoder(spec, *, features=..., ...)``; every size is measured from the spec.

    Attributes:
        spec: the observations it takes (those of the data that it uses).
        features: M, the width of what it returns.
        positions: of a grid whose features stand one after the other in M, each to be bottlenecked alone; 1 for none.
    """

    positions: int = 1

    def __init__(self, spec: DataSpec, features: int) -> None:
        super().__init__()
        if features < 1:
            raise UserError(f"{type(self).__name__}: features must be at least 1, is {features}")
        self.spec = spec
        self.features = features

    def forward(self, observations: dict[str, Tensor]) -> Tensor:
        """Encode name -> (N, *shape) (uint8 pictures, float32 sensors) into (N, M)."""
        raise NotImplementedError
