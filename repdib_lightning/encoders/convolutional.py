"""Stacks of plain convolutions (DrQ-v2's, DQN's), for any picture size, channel count and number of views."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from repdib_lightning.encoders.base import Encoder
from repdib_lightning.encoders.mean_picture import MeanPicture
from repdib_lightning.encoders.views import centred, image_views, seen_only
from repdib_lightning.errors import UserError
from repdib_lightning.records import DataSpec


class ConvolutionalEncoder(Encoder):
    """Unpadded convolutions with ReLU, then ``Linear -> LayerNorm -> Tanh`` to M. By default the 3x3 convolutions of
    DrQ-v2 (Yarats et al. 2021; as an encoder of width M with its trunk: Islam et al. 2022, ACRO).

    Each view has a stack of its own; their flattened maps are joined before the linear layer. Frame stacks arrive as
    channels.

    Args:
        spec: observations; every size is measured from it.
        features: M.
        channels: channels of each convolution: one number for all, or one for each.
        strides: one convolution for each entry. DrQ-v2: [2, 1, 1, 1]; [2, 2, 1, 1] costs a quarter of it.
        kernels: side of each convolution's kernel; 3 by default. DQN (Mnih et al. 2015), and the Decision Transformer's
            encoder of Atari: channels [32, 64, 64], strides [4, 2, 1], kernels [8, 4, 3].
        views: names of the pictures to use; all by default.
        subtract_mean: subtract the mean picture of the training data (:class:`MeanPicture`), in place of one half.

    Raises:
        UserError: no picture in the spec, an unknown view, lists of different lengths, or a picture too small for the
            convolutions.
    """

    def __init__(
        self,
        spec: DataSpec,
        *,
        features: int = 256,
        channels: int | list[int] = 32,
        strides: list[int] | None = None,
        views: list[str] | None = None,
        kernels: list[int] | None = None,
        subtract_mean: bool = False,
    ) -> None:
        views = image_views(spec, views, "ConvolutionalEncoder")
        super().__init__(seen_only(spec, views), features)
        self.views = views
        strides = [2, 1, 1, 1] if strides is None else strides
        kernels = [3] * len(strides) if kernels is None else kernels
        widths = [channels] * len(strides) if isinstance(channels, int) else channels
        sizes = {"channels": widths, "strides": strides, "kernels": kernels}
        for name in ("strides", "kernels", "channels"):
            if min(sizes[name], default=0) < 1:
                raise UserError(f"ConvolutionalEncoder: {name} ({sizes[name]}) must be at least 1")
        if len({len(values) for values in sizes.values()}) > 1:
            told = ", ".join(f"{name} ({values})" for name, values in sizes.items())
            raise UserError(f"ConvolutionalEncoder: {told} must be lists equally long")
        self.means = nn.ModuleDict()
        self.stacks = nn.ModuleDict()
        width = 0
        for view in self.views:
            shape = spec.observations[view].shape
            if subtract_mean:
                self.means[view] = MeanPicture(shape)
            stack = convolution_stack(shape[0], widths, strides, kernels)
            self.stacks[view] = stack
            width += flat_width(stack, view, shape)
        self.trunk = nn.Sequential(nn.Linear(width, features), nn.LayerNorm(features), nn.Tanh())
        self.apply(initialise_orthogonally)

    def forward(self, observations: dict[str, Tensor]) -> Tensor:
        """Encode name -> (N, S * C, H, W) uint8 into (N, M) in (-1, 1)."""
        maps = [self.stacks[view](self._centred(view, observations[view])).flatten(1) for view in self.views]
        return self.trunk(torch.cat(maps, dim=1))

    def _centred(self, view: str, pictures: Tensor) -> Tensor:
        found: Tensor = self.means[view](pictures) if view in self.means else centred(pictures)
        return found


def convolution_stack(in_channels: int, channels: list[int], strides: list[int], kernels: list[int]) -> nn.Sequential:
    """An unpadded convolution with ReLU for each entry of the lists."""
    layers: list[nn.Module] = []
    for width, stride, kernel in zip(channels, strides, kernels, strict=True):
        layers += [nn.Conv2d(in_channels, width, kernel, stride), nn.ReLU()]
        in_channels = width
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
            stride, kernel, channels = layer.stride[0], layer.kernel_size[0], layer.out_channels
            height, width = (height - kernel) // stride + 1, (width - kernel) // stride + 1
        if height < 1 or width < 1:
            convolutions = [layer for layer in stack if isinstance(layer, nn.Conv2d)]
            sizes = (
                f"strides {[c.stride[0] for c in convolutions]} of kernels {[c.kernel_size[0] for c in convolutions]}"
            )
            raise UserError(f"ConvolutionalEncoder: '{view}' of {shape[1]}x{shape[2]} pixels is too small for {sizes}")
    return channels * height * width


def initialise_orthogonally(module: nn.Module) -> None:
    """DrQ-v2's start: orthogonal weights (ReLU gain for convolutions), zero biases."""
    if isinstance(module, nn.Conv2d):
        nn.init.orthogonal_(module.weight, nn.init.calculate_gain("relu"))
    elif isinstance(module, nn.Linear):
        nn.init.orthogonal_(module.weight)
    if isinstance(module, (nn.Conv2d, nn.Linear)) and module.bias is not None:
        nn.init.zeros_(module.bias)
