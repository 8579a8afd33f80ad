"""Plain InfoNCE over time: recognise a state's own future."""

from __future__ import annotations

import math

import torch.nn.functional as F
from torch import Tensor, nn

from repdib_lightning.bottlenecks.precision import at_least_single
from repdib_lightning.errors import UserError
from repdib_lightning.objectives.contrast import TemporalContrast
from repdib_lightning.records import DataSpec


class InfoNCE(TemporalContrast):
    """Contrast over time with the loss of van den Oord et al. 2018 (section 2.3) and the projection head, cosine
    similarity and temperature of SimCLR (Chen et al. 2020, section 2.1).

    The score of a pair is the cosine of g(z_t) and h(z_{t+k}) over the temperature. g and h are two-layer networks of
    their own, since time has a direction; neither knows the action or k.

    It is not contrastive predictive coding in full: no autoregressive context, and no predictor for each k. It is not
    SimCLR: the positive is a later frame instead of another view of the same one, only anchors choose among futures
    and not also the reverse, and anchors are not each other's negatives.

    Args:
        width: M, also that of the hidden layers.
        spec: which frames of a sample are drawn futures; any data will do.
        projection: width in which pairs are compared.
        temperature: divides the cosine; small ones weigh the hardest candidates more.

    Raises:
        UserError: an option out of range.
    """

    def __init__(self, width: int, spec: DataSpec, *, projection: int = 128, temperature: float = 0.1) -> None:
        super().__init__(spec)
        if projection < 1:
            raise UserError(f"InfoNCE: projection must be at least 1, is {projection}")
        if not (temperature > 0 and math.isfinite(temperature)):
            raise UserError(f"InfoNCE: temperature must be a positive number, is {temperature}")
        self.temperature = temperature
        self.anchor_head = nn.Sequential(nn.Linear(width, width), nn.ReLU(), nn.Linear(width, projection))
        self.future_head = nn.Sequential(nn.Linear(width, width), nn.ReLU(), nn.Linear(width, projection))

    def describe_anchors(self, latents: Tensor, actions: Tensor | None) -> Tensor:
        """g: anchors (B, M) to unit vectors (B, projection)."""
        return _unit(self.anchor_head(latents))

    def describe_futures(self, latents: Tensor) -> Tensor:
        """h: futures (..., M) to unit vectors (..., projection)."""
        return _unit(self.future_head(latents))

    def score(self, products: Tensor) -> Tensor:
        """Divide the cosines by the temperature."""
        return products / self.temperature


def _unit(rows: Tensor) -> Tensor:
    return F.normalize(rows.to(at_least_single(rows.dtype)), dim=-1)
