"""Networks that make one vector of a picture, for the frames of a clip."""

from __future__ import annotations

from functools import partial
from pathlib import Path

import torch
from torch import Tensor, nn

from repdib_lightning.encoders.convolutional import initialise_orthogonally
from repdib_lightning.encoders.views import centred
from repdib_lightning.errors import UserError, nearest

FRAME_NETWORKS = ("small", "resnet18", "resnet34", "resnet50")
FRAME_NORMS = ("group", "frozen")
_IMAGENET_MEAN, _IMAGENET_STD = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)
_SMALL_CHANNELS, _SMALL_SIDE = (16, 32, 64), 4


def frame_network(name: str, shape: tuple[int, ...], norm: str, weights: str | None) -> tuple[nn.Module, int]:
    """A network (N, C, H, W) uint8 -> (N, width), and its width.

    Args:
        name: one of ``FRAME_NETWORKS``.
        shape: (C, H, W) of a frame.
        norm: see :class:`ResNetFrames`.
        weights: see :class:`ResNetFrames`.

    Raises:
        UserError: an unknown network or norm, frames that are too small, weights that do not fit.
    """
    if name not in FRAME_NETWORKS:
        raise UserError(f"MultimodalEncoder: unknown network '{name}', {nearest(name, FRAME_NETWORKS)}")
    if norm not in FRAME_NORMS:
        raise UserError(f"MultimodalEncoder: unknown norm '{norm}', {nearest(norm, FRAME_NORMS)}")
    if name == "small":
        if weights:
            raise UserError(
                "MultimodalEncoder: weights are of a ResNet, network is 'small'; set network: resnet18, 34 or 50"
            )
        small = SmallFrames(shape)
        return small, small.width
    resnet = ResNetFrames(name, shape[0], norm, weights)
    return resnet, resnet.width


class SmallFrames(nn.Module):
    """An 8x8 convolution with stride 4, then 3x3 ones with stride 2 until no side is above 4 (64 px: two of them).

    The maps are normalised together (LayerNorm), and biases start at 0: little of a picture changes from frame to
    frame, and beside the sensors of a clip a network that starts dull is never trained.

    Made for clips on a CPU: at 64 px a frame costs 0.9 million multiplications forward.

    Args:
        shape: (C, H, W).

    Raises:
        UserError: frames with a side below 4 pixels.
    """

    def __init__(self, shape: tuple[int, ...]) -> None:
        super().__init__()
        channels, height, width = shape
        if min(height, width) < 4:
            raise UserError(f"MultimodalEncoder: frames of {height}x{width} pixels are too small, 4 is the least")
        layers: list[nn.Module] = [nn.Conv2d(channels, _SMALL_CHANNELS[0], 8, stride=4, padding=2), nn.ReLU()]
        height, width, last, stage = height // 4, width // 4, _SMALL_CHANNELS[0], 1
        while max(height, width) > _SMALL_SIDE:
            after = _SMALL_CHANNELS[min(stage, len(_SMALL_CHANNELS) - 1)]
            layers += [nn.Conv2d(last, after, 3, stride=2, padding=1), nn.ReLU()]
            height, width, last, stage = (height + 1) // 2, (width + 1) // 2, after, stage + 1
        self.width = last * height * width
        self.layers = nn.Sequential(*layers, nn.Flatten(), nn.LayerNorm(self.width))
        self.apply(initialise_orthogonally)

    def forward(self, frames: Tensor) -> Tensor:
        """(N, C, H, W) uint8 to (N, width)."""
        maps: Tensor = self.layers(centred(frames))
        return maps


class ResNetFrames(nn.Module):
    """A torchvision ResNet up to its pooled features (He et al. 2016), on pictures normalised as those of ImageNet.

    Args:
        architecture: resnet18, resnet34 or resnet50.
        channels: C; other than 3 gets a first convolution of its own.
        norm: ``group``, or ``frozen``: batch normalisation whose statistics stay as the weights have them, so that
            frames that are missing, and the other clips of a batch, do not count.
        weights: file of a state dict with torchvision's names (.safetensors, .pth), to start from; needs ``frozen``.

    Raises:
        UserError: no such file, one that is not readable, or weights that do not fit.
    """

    mean: Tensor
    std: Tensor

    def __init__(self, architecture: str, channels: int, norm: str, weights: str | None) -> None:
        import torchvision  # a second of import that only this network needs

        super().__init__()
        if weights and norm != "frozen":
            raise UserError("MultimodalEncoder: weights hold statistics of batch normalisation; set norm: frozen")
        kinds = {"group": partial(nn.GroupNorm, 32), "frozen": torchvision.ops.FrozenBatchNorm2d}
        network = torchvision.models.get_model(architecture, weights=None, norm_layer=kinds[norm])
        self.width: int = network.fc.in_features
        network.fc = nn.Identity()
        if channels != 3:
            network.conv1 = nn.Conv2d(channels, 64, kernel_size=7, stride=2, padding=3, bias=False)
        if weights:
            load_torchvision_weights(network, Path(weights))
        self.network = network
        coloured = channels == 3
        mean = _IMAGENET_MEAN if coloured else (sum(_IMAGENET_MEAN) / 3,) * channels
        std = _IMAGENET_STD if coloured else (sum(_IMAGENET_STD) / 3,) * channels
        self.register_buffer("mean", torch.tensor(mean).view(-1, 1, 1), persistent=False)
        self.register_buffer("std", torch.tensor(std).view(-1, 1, 1), persistent=False)

    def forward(self, frames: Tensor) -> Tensor:
        """(N, C, H, W) uint8 to (N, width)."""
        pooled: Tensor = self.network((centred(frames) + (0.5 - self.mean)) / self.std)
        return pooled


def load_torchvision_weights(network: nn.Module, path: Path) -> None:
    """Fill a ResNet without its classifier from a file of torchvision's own names.

    Raises:
        UserError: see :class:`ResNetFrames`.
    """
    if not path.is_file():
        raise UserError(f"MultimodalEncoder: weights: {path}: no such file")
    try:
        if path.suffix == ".safetensors":
            from safetensors.torch import load_file

            tensors = load_file(path)
        else:
            tensors = torch.load(path, map_location="cpu", weights_only=True)
        given = {name: value for name, value in tensors.items() if not name.startswith("fc.")}
    # Damaged pickles fail in any way they like.
    except Exception as error:
        why = (str(error).splitlines() or [type(error).__name__])[0]
        raise UserError(f"MultimodalEncoder: weights: {path}: not a readable state dict ({why})") from error
    expected = network.state_dict()
    given = {name: value for name, value in given.items() if not name.endswith("num_batches_tracked")}
    for name in [*expected, *given]:
        if name not in given or name not in expected:
            raise UserError(
                f"MultimodalEncoder: weights: {path}: '{name}' is {'left over' if name in given else 'missing'}"
            )
        if given[name].shape != expected[name].shape:
            shapes = f"{tuple(given[name].shape)}, the network has {tuple(expected[name].shape)}"
            raise UserError(f"MultimodalEncoder: weights: {path}: '{name}' is {shapes}")
    network.load_state_dict(given)
