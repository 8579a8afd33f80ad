"""A picture network of torchvision without its last layer, and the file of its weights."""

from __future__ import annotations

import hashlib
from pathlib import Path

import numpy as np
import torch
import torchvision
from safetensors.torch import load_file
from torch import Tensor, nn

from repdib_lightning.errors import UserError

WIDTHS = {"resnet18": 512, "resnet34": 512, "resnet50": 2048}
"""Architecture -> numbers a frame."""

MEAN, STD = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)
"""Of ImageNet's channels, in [0, 1]."""

_COUNTERS = "num_batches_tracked"  # the oldest files lack them, and no evaluation reads them


class FrameNetwork(nn.Module):
    """Maps (n, C, H, W) uint8 frames to (n, width) float32; grey ones are repeated to three channels.

    Args:
        architecture: a key of :data:`WIDTHS`.
        weights: a file of torchvision's own state dict (.pth or .safetensors); None draws them at random.
        seed: of random weights.

    Attributes:
        width: numbers a frame.
        sha256: of the file, or of the random weights.

    Raises:
        UserError: the file cannot be read, is of another architecture, or holds values that are not finite.
    """

    mean: Tensor
    std: Tensor

    def __init__(self, architecture: str, weights: Path | None = None, seed: int = 0) -> None:
        super().__init__()
        self.width = WIDTHS[architecture]
        with torch.random.fork_rng(devices=[]):
            torch.random.default_generator.manual_seed(seed)  # torch.manual_seed would also seed every GPU
            self.network = _headless(architecture)
        if weights is None:
            self.sha256 = _hash_of(self.network)
        else:
            self.network.load_state_dict(_state_of(weights, architecture, self.network), strict=False)
            self.sha256 = hashlib.sha256(weights.read_bytes()).hexdigest()
        self.register_buffer("mean", torch.tensor(MEAN)[:, None, None] * 255)
        self.register_buffer("std", torch.tensor(STD)[:, None, None] * 255)
        self.eval().requires_grad_(False)

    def forward(self, frames: Tensor) -> Tensor:
        """(n, C, H, W) uint8, C = 1 or 3, to (n, width)."""
        features: Tensor = self.network((frames.expand(-1, 3, -1, -1) - self.mean) / self.std)
        return features

    def features_of(self, frames: np.ndarray, batch: int) -> np.ndarray:
        """Features of frames, ``batch`` at a time: (n, C, H, W) uint8 to (n, width) float32; n = 0 is fine."""
        features = np.empty((len(frames), self.width), np.float32)
        with torch.inference_mode():
            for first in range(0, len(frames), batch):
                part = torch.from_numpy(frames[first : first + batch])
                features[first : first + batch] = self(part.to(self.mean.device)).cpu().numpy()
        return features


def _headless(architecture: str) -> nn.Module:
    network: nn.Module = torchvision.models.get_model(architecture, weights=None)
    network.fc = nn.Identity()
    return network


def _hash_of(network: nn.Module) -> str:
    digest = hashlib.sha256()
    for name, tensor in sorted(network.state_dict().items()):
        digest.update(name.encode())
        digest.update(tensor.numpy().tobytes())
    return digest.hexdigest()


def _state_of(path: Path, architecture: str, network: nn.Module) -> dict[str, Tensor]:
    state = _read(path)
    found = _shapes(state)
    expected = _shapes(network.state_dict())
    if found != expected:
        raise UserError(f"--weights {path}: {_difference(found, expected, architecture)}")
    kept = {name: tensor for name, tensor in state.items() if not name.startswith("fc.")}
    for name, tensor in kept.items():
        if not torch.isfinite(tensor).all():
            raise UserError(f"--weights {path}: '{name}' holds NaN or infinite values")
    return kept


def _read(path: Path) -> dict[str, Tensor]:
    if not path.is_file():
        raise UserError(f"--weights {path}: no such file; leave the option out for random weights")
    try:
        if path.suffix == ".safetensors":
            return load_file(path)
        state = torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:  # torch lets whatever it stumbles over through
        reason = f"{type(error).__name__}: {error}".partition("\n")[0]
        raise UserError(f"--weights {path}: not a readable file of weights ({reason:.120})") from error
    if not isinstance(state, dict) or not all(isinstance(tensor, Tensor) for tensor in state.values()):
        held = f"a dict of {', '.join(map(str, list(state)[:4]))}" if isinstance(state, dict) else type(state).__name__
        raise UserError(f"--weights {path}: holds {held}; save the state_dict() of torchvision's network alone")
    return state


def _shapes(state: dict[str, Tensor]) -> dict[str, tuple[int, ...]]:
    return {
        name: tuple(tensor.shape)
        for name, tensor in state.items()
        if not str(name).startswith("fc.") and not str(name).endswith(_COUNTERS)
    }


def _difference(found: dict[str, tuple[int, ...]], expected: dict[str, tuple[int, ...]], architecture: str) -> str:
    for other in WIDTHS:
        with torch.device("meta"):
            fits = _shapes(_headless(other).state_dict()) == found
        if fits:
            return f"holds a {other}, --architecture is {architecture}"
    name = next(name for name in {**expected, **found} if found.get(name) != expected.get(name))
    shown = [" x ".join(map(str, shapes[name])) if name in shapes else "absent" for shapes in (found, expected)]
    return f"is not torchvision's {architecture}: '{name}' is {shown[0]} there, must be {shown[1]}"
