"""One hidden layer."""

from __future__ import annotations

from torch import Tensor, nn

from repdib_lightning.classifiers.base import Classifier
from repdib_lightning.classifiers.dropout import SampleDropout
from repdib_lightning.errors import UserError
from repdib_lightning.records import DataSpec


class MLPClassifier(Classifier):
    """Dropout, a linear layer, ReLU, a linear layer (Islam and Iqbal 2020, HAMLET: the end of its network).

    Args:
        spec: of the data; gives the classes.
        width: M.
        hidden: width of the hidden layer.
        dropout: share of the latent's numbers that are set to 0 in training.

    Raises:
        UserError: as :class:`Classifier`, a hidden layer of no width, or a dropout outside [0, 1).
    """

    def __init__(self, spec: DataSpec, width: int, *, hidden: int = 128, dropout: float = 0.0) -> None:
        super().__init__(spec, width)
        name = type(self).__name__
        if hidden < 1:
            raise UserError(f"{name}: hidden must be at least 1, is {hidden}")
        self.layers = nn.Sequential(
            SampleDropout(dropout, name), nn.Linear(width, hidden), nn.ReLU(), nn.Linear(hidden, len(self.classes))
        )

    def forward(self, latents: Tensor) -> Tensor:
        """Unnormalised log-probabilities (N, classes) of (N, M)."""
        scores: Tensor = self.layers(latents)
        return scores
