"""The convolution stack of DrQ-v2, for any picture size, channel count and number of views."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from repdib_lightning.encoders.base import Encoder
from repdib_lightning.encoders.views import centred, image_views, seen_only
from repdib_lightning.errors import UserError
from repdib_lightning.records import DataSpec


class ConvolutionalEncoder(Encoder):
    """3x3 convolutions with ReLU, then ``Linear -> LayerNorm -> Tanh`` to M (Yarats et al. 2021, DrQ-v2; as an
    encoder of width M with its trunk: Islam et al. 2022, ACRO).

    Each view has a stack of its own; their flattened maps are joined before the linear layer. Frame stacks arrive as
    channels.

    Args:
        spec: observations; every size is measured from it.
        features: M.
        channels: channels of each convolution.
        strides: one convolution for each entry. DrQ-v2: [2, 1, 1, 1]; [2, 2, 1, 1] costs a quarter of it.
        views: names of the pictures to use; all by default.

    Raises:
        UserError: no picture in the spec, an unknown view, or a picture too small for the strides.
    """

    def __init__(
        self,
        spec: DataSpec,
        *,
        features: int = 256,
        channels: int = 32,
        strides: list[int] | None = None,
        views: list[str] | None = None,
    ) -> None:
        views = image_views(spec, views, "ConvolutionalEncoder")
        super().__init__(seen_only(spec, views), features)
        self.views = views
        strides = [2, 1, 1, 1] if strides is None else strides
        if channels < 1 or not strides or min(strides) < 1:
            raise UserError(f"ConvolutionalEncoder: channels ({channels}) and strides ({strides}) must be at least 1")
        self.stacks = nn.ModuleDict()
        width = 0
        for view in self.views:
            shape = spec.observations[view].shape
            stack = convolution_stack(shape[0], channels, strides)
            self.stacks[view] = stack
            width += flat_width(stack, view, shape)
        self.trunk = nn.Sequential(nn.Linear(width, features), nn.LayerNorm(features), nn.Tanh())
        self.apply(initialise_orthogonally)

    def forward(self, observations: dict[str, Tensor]) -> Tensor:
        """Encode name -> (N, S * C, H, W) uint8 into (N, M) in (-1, 1)."""
        maps = [self.stacks[view](centred(observations[view])).flatten(1) for view in self.views]
        return self.trunk(torch.cat(maps, dim=1))


def convolution_stack(in_channels: int, channels: int, strides: list[int]) -> nn.Sequential:
    """One unpadded 3x3 convolution with ReLU for each stride."""
    layers: list[nn.Module] = []
    for stride in strides:
        layers += [nn.Conv2d(in_channels, channels, 3, stride), nn.ReLU()]
        in_channels = channels
    return nn.Sequential(*layers)


def flat_width(stack: nn.Sequential, view: str, shape: tuple[int, ...]) -> int:
    """Elements that a stack makes of one picture (C, H, W).

    Raises:
        UserError: a convolution has nothing left to cover.
    """
    height, width = shape[1:]
    channels = shape[0]
    for layer in stack:
        if isinstance(layer, nn.Conv2d):
            stride, channels = layer.stride[0], layer.out_channels
            height, width = (height - 3) // stride + 1, (width - 3) // stride + 1
        if height < 1 or width < 1:
            raise UserError(f"ConvolutionalEncoder: '{view}' of {shape[1]}x{shape[2]} pixels is too small for strides")
    return channels * height * width


def initialise_orthogonally(module: nn.Module) -> None:
    """DrQ-v2's start: orthogonal weights (ReLU gain for convolutions), zero biases."""
    if isinstance(module, nn.Conv2d):
        nn.init.orthogonal_(module.weight, nn.init.calculate_gain("relu"))
    elif isinstance(module, nn.Linear):
        nn.init.orthogonal_(module.weight)
    if isinstance(module, (nn.Conv2d, nn.Linear)) and module.bias is not None:
        nn.init.zeros_(module.bias)
