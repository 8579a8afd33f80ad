"""The contract of a classifier."""

from __future__ import annotations

from torch import Tensor

from repdib_lightning.arguments import RememberedArguments
from repdib_lightning.errors import UserError
from repdib_lightning.records import DataSpec


class Classifier(RememberedArguments):
    """Tells the class of the data's target from a latent.

    Subclasses are built as ``Classifier(spec, width, *, ...)``.

    Attributes:
        target: the factor that is recognised.
        classes: names of its values, in the order of the numbers that :meth:`forward` gives.
        width: M.

    Raises:
        UserError: data without a target, or with fewer than two classes of it.
    """

    supplied = 2

    def __init__(self, spec: DataSpec, width: int) -> None:
        super().__init__()
        name = type(self).__name__
        if not spec.target:
            raise UserError(f"{name}: nothing is to be recognised; set data.target to a categorical factor of the data")
        if len(spec.classes) < 2:
            raise UserError(
                f"{name}: the target '{spec.target}' has {len(spec.classes)} classes, there is nothing to tell apart; "
                "set data.target to another factor"
            )
        self.target, self.classes, self.width = spec.target, spec.classes, width

    def forward(self, latents: Tensor) -> Tensor:
        """Unnormalised log-probabilities (N, classes) of (N, M)."""
        raise NotImplementedError
