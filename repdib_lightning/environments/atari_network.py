"""The network that plays Atari from pixels, and the file that holds it at several ages."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import nn

from repdib_lightning.data.files import whole_file
from repdib_lightning.errors import UserError, nearest

_KEY = "atari_policy"


class NatureNetwork(nn.Module):
    """Values of actions from stacked grey frames (Mnih et al. 2015): three convolutions and a hidden layer, ReLU.

    Args:
        stack: S, frames.
        image_size: their height and width in pixels.
        actions: A.
    """

    def __init__(self, stack: int, image_size: int, actions: int) -> None:
        super().__init__()
        side = ((image_size - 8) // 4 - 3) // 2 - 1  # 7 of 84
        self.layers = nn.Sequential(
            nn.Conv2d(stack, 32, 8, 4),
            nn.ReLU(),
            nn.Conv2d(32, 64, 4, 2),
            nn.ReLU(),
            nn.Conv2d(64, 64, 3, 1),
            nn.ReLU(),
            nn.Flatten(),
            nn.Linear(64 * side * side, 512),
            nn.ReLU(),
            nn.Linear(512, actions),
        )

    def forward(self, frames: torch.Tensor) -> torch.Tensor:
        """(B, S, H, W) uint8 to (B, A) values."""
        values: torch.Tensor = self.layers(frames.float() / 255.0)
        return values

    @torch.no_grad()
    def best(self, frames: np.ndarray) -> int:
        """(S, H, W) uint8 to the action of the highest value."""
        return int(self(torch.from_numpy(frames[None])).argmax())


@dataclass(frozen=True)
class AtariPolicyFile:
    """Networks of one training, of several ages.

    Attributes:
        path: where they were read. facts: the file's metadata: ``game``, ``frame_skip``, ``sticky``, ``stack``,
            ``image_size``, ``actions``, ``command``, and ``networks``, steps -> ``return``.
    """

    path: Path
    facts: Mapping[str, Any]

    @property
    def ages(self) -> list[int]:
        """Steps after which networks were kept, ascending."""
        return sorted(int(steps) for steps in self.facts["networks"])

    def network(self, age: int | None = None) -> NatureNetwork:
        """The network after so many steps, the last one by default, in evaluation mode.

        Raises:
            UserError: there is none of that age, or the file was changed.
        """
        age = self.ages[-1] if age is None else age
        if age not in self.ages:
            raise UserError(f"--policy {self.path}: has no network dqn-{age}, {nearest(f'dqn-{age}', self.names)}")
        network = NatureNetwork(self.facts["stack"], self.facts["image_size"], self.facts["actions"])
        try:
            with safe_open(self.path, framework="pt") as file:
                network.load_state_dict({key: file.get_tensor(f"{age}/{key}") for key in network.state_dict()})
        except (SafetensorError, OSError, RuntimeError) as error:
            raise _not_a_policy(self.path, error) from error
        return network.eval()

    @property
    def names(self) -> list[str]:
        """What a mixture calls the networks: ``dqn-STEPS``."""
        return [f"dqn-{age}" for age in self.ages]


def read_atari_policy(path: Path, *, game: str, frame_skip: int, image_size: int) -> AtariPolicyFile:
    """Read a file of ``collect atari_policy`` and check that its networks can play.

    Args:
        path: the file. game, frame_skip, image_size: what they are to play.

    Raises:
        UserError: no such file, another kind of file, or trained on another game, frame skip or picture size.
    """
    if not path.is_file():
        raise UserError(f"--policy {path}: no such file")
    try:
        with safe_open(path, framework="pt") as file:
            facts = json.loads((file.metadata() or {})[_KEY])
        read = AtariPolicyFile(path, facts)
        if not read.ages:
            raise ValueError("it holds no networks")
        told = {name: facts[name] for name in ("game", "frame_skip", "image_size")}
        read.network()
    except (SafetensorError, OSError, KeyError, TypeError, ValueError, AttributeError) as error:
        if isinstance(error, UserError):
            raise
        raise _not_a_policy(path, error) from error
    for name, wanted in (("game", game), ("frame_skip", frame_skip), ("image_size", image_size)):
        if told[name] != wanted:
            raise UserError(f"--policy {path}: was trained with {name}={told[name]}, this recording has {wanted}")
    return read


def _not_a_policy(path: Path, error: Exception) -> UserError:
    reason = str(error).splitlines()[0] if str(error) else ""
    return UserError(f"--policy {path}: not a policy of 'collect atari_policy' ({type(error).__name__}: {reason})")


def write_atari_policy(
    path: Path, facts: Mapping[str, Any], networks: Mapping[int, Mapping[str, torch.Tensor]]
) -> None:
    """Write networks, whole.

    Args:
        path: the file. facts: see :class:`AtariPolicyFile`. networks: steps -> state of a :class:`NatureNetwork`.

    Raises:
        UserError: the file cannot be written.
    """
    tensors = {f"{age}/{key}": tensor.contiguous() for age, state in networks.items() for key, tensor in state.items()}
    with whole_file(path) as aside:
        save_file(tensors, aside, metadata={_KEY: json.dumps(dict(facts))})
