"""One linear layer."""

from __future__ import annotations

from torch import Tensor, nn

from repdib_lightning.classifiers.base import Classifier
from repdib_lightning.classifiers.dropout import SampleDropout
from repdib_lightning.records import DataSpec


class LinearClassifier(Classifier):
    """Dropout, then one linear layer.

    Args:
        spec: of the data; gives the classes.
        width: M.
        dropout: share of the latent's numbers that are set to 0 in training.

    Raises:
        UserError: as :class:`Classifier`, or a dropout outside [0, 1).
    """

    def __init__(self, spec: DataSpec, width: int, *, dropout: float = 0.0) -> None:
        super().__init__(spec, width)
        self.layers = nn.Sequential(SampleDropout(dropout, type(self).__name__), nn.Linear(width, len(self.classes)))

    def forward(self, latents: Tensor) -> Tensor:
        """Unnormalised log-probabilities (N, classes) of (N, M)."""
        scores: Tensor = self.layers(latents)
        return scores
