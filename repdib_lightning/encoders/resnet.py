"""A torchvision ResNet as an encoder."""

from __future__ import annotations

from functools import partial

import torch
from torch import Tensor, nn

from repdib_lightning.encoders.base import Encoder
from repdib_lightning.encoders.views import centred, image_views, seen_only
from repdib_lightning.errors import UserError, nearest
from repdib_lightning.records import DataSpec

_ARCHITECTURES = ("resnet18", "resnet34", "resnet50")


class ResNetEncoder(Encoder):
    """A ResNet for each view (He et al. 2016), joined by ``Linear -> LayerNorm -> Tanh`` to M.

    Args:
        spec: observations; pictures of any size and channel count (the first convolution is made for them).
        features: M.
        architecture: resnet18, resnet34 or resnet50.
        norm: ``batch`` (the original), or ``group``, which does not mix the samples of a batch.
        views: names of the pictures to use; all by default.

    Raises:
        UserError: an unknown architecture, norm or view.
    """

    def __init__(
        self,
        spec: DataSpec,
        *,
        features: int = 256,
        architecture: str = "resnet18",
        norm: str = "batch",
        views: list[str] | None = None,
    ) -> None:
        import torchvision  # a second of import that only this encoder needs

        views = image_views(spec, views, "ResNetEncoder")
        super().__init__(seen_only(spec, views), features)
        self.views = views
        if architecture not in _ARCHITECTURES:
            raise UserError(
                f"ResNetEncoder: unknown architecture '{architecture}', {nearest(architecture, _ARCHITECTURES)}"
            )
        if norm not in ("batch", "group"):
            raise UserError(f"ResNetEncoder: unknown norm '{norm}', {nearest(norm, ('batch', 'group'))}")
        self.networks = nn.ModuleDict()
        width = 0
        for view in self.views:
            network = torchvision.models.get_model(
                architecture, weights=None, norm_layer=nn.BatchNorm2d if norm == "batch" else partial(nn.GroupNorm, 32)
            )
            channels = spec.observations[view].shape[0]
            network.conv1 = nn.Conv2d(channels, 64, kernel_size=7, stride=2, padding=3, bias=False)
            width += network.fc.in_features
            network.fc = nn.Identity()
            self.networks[view] = network
        self.trunk = nn.Sequential(nn.Linear(width, features), nn.LayerNorm(features), nn.Tanh())

    def forward(self, observations: dict[str, Tensor]) -> Tensor:
        """Encode name -> (N, S * C, H, W) uint8 into (N, M) in (-1, 1)."""
        pooled = [self.networks[view](centred(observations[view])) for view in self.views]
        return self.trunk(torch.cat(pooled, dim=1))
