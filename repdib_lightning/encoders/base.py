"""The contract of an encoder."""

from __future__ import annotations

from dataclasses import dataclass, field

from torch import Tensor

from repdib_lightning.arguments import RememberedArguments
from repdib_lightning.errors import UserError
from repdib_lightning.records import DataSpec


@dataclass
class EncoderOutput:
    """What an encoder gives beside its features, where it has something inside that can be looked at.

    Attributes:
        features: (N, M).
        losses: named scalars of bottlenecks inside, unweighted.
        metrics: named detached scalars worth logging.
        codes: name of a modality -> (N, G) int64, where it is quantised.
        attention: ``modalities`` -> (N, number of them), and the name of a modality -> (N, steps): non-negative, with
            sum 1 over what was observed, 0 for what was not.
    """

    features: Tensor
    losses: dict[str, Tensor] = field(default_factory=dict)
    metrics: dict[str, Tensor] = field(default_factory=dict)
    codes: dict[str, Tensor] = field(default_factory=dict)
    attention: dict[str, Tensor] = field(default_factory=dict)


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

    def detailed(self, observations: dict[str, Tensor]) -> EncoderOutput:
        """The same features with all that is inside: losses of bottlenecks, their codes, attention."""
        return EncoderOutput(self(observations))

    def require_ready(self) -> None:
        """Raise UserError, with what to do about it, unless every bottleneck inside is ready to be exported."""
