"""A trained offline policy as a file of tensors, and as a function of observations."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import nn

from repdib_lightning.data.files import whole_file
from repdib_lightning.errors import UserError
from repdib_lightning.export.frozen import FrozenEncoder
from repdib_lightning.export.load import load_encoder
from repdib_lightning.export.observations import Observations
from repdib_lightning.rl.networks import Actor, StandardisedLatents
from repdib_lightning.rl.offline_options import OfflineOptions

POLICY = "policy.safetensors"


class OfflinePolicy:
    """A frozen encoder and an actor: observations to actions.

    Attributes:
        encoder: what :func:`~repdib_lightning.export.load_encoder` returned.
    """

    def __init__(self, encoder: FrozenEncoder, standardise: nn.Module, actor: Actor) -> None:
        self.encoder, self._standardise, self._actor = encoder, standardise.eval(), actor.eval()

    @torch.inference_mode()
    def __call__(self, observations: Observations) -> np.ndarray:
        """(N, *shape), stacked as the encoder's spec says, to actions (N, A); or (*shape) to (A,)."""
        latents = self.encoder.encode(observations)
        acted: np.ndarray = self._actor(self._standardise(latents)).cpu().numpy()
        return acted


def save_policy(folder: Path, actor: Actor, features: nn.Module, options: OfflineOptions) -> None:
    """Write ``policy.safetensors``: the actor, and the standardiser of a frozen encoder's latents."""
    tensors = {f"actor.{name}": value for name, value in actor.state_dict().items()}
    if isinstance(features, StandardisedLatents):
        tensors |= {f"standardise.{name}": value for name, value in features.state_dict().items()}
    facts = {"agent": options.agent, "encoder": None if options.encoder is None else str(options.encoder)}
    with whole_file(folder / POLICY) as aside:
        save_file({n: v.detach().cpu().contiguous() for n, v in tensors.items()}, aside, {"policy": json.dumps(facts)})


def load_policy(folder: str | Path, encoder: str | Path | None = None) -> OfflinePolicy:
    """Load what ``finetune td3bc`` or ``finetune bc`` trained.

    Args:
        folder: of that run.
        encoder: the bundle; by default the run's own, or the one that it was trained on.

    Raises:
        UserError: no such run or bundle, a damaged file, or a bundle of another width.
    """
    path = Path(folder) / POLICY
    if not path.is_file():
        raise UserError(f"{folder}: holds no {POLICY}; name the folder of a finished run of finetune td3bc or bc")
    try:
        with safe_open(path, framework="pt") as file:
            facts = json.loads((file.metadata() or {})["policy"])
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 (not a dictionary)
        shapes = [tensors[f"actor.network.{layer}.weight"].shape for layer in (0, 4)]
    except (SafetensorError, KeyError, ValueError, OSError) as error:
        raise UserError(f"{path}: not a policy of finetune td3bc or bc ({type(error).__name__}: {error})") from error
    own = Path(folder) / "bundle"
    named = encoder or (own if own.is_dir() else facts["encoder"])
    bundle = Path(named) / "bundle" if (Path(named) / "bundle").is_dir() else Path(named)
    frozen = load_encoder(bundle)
    width = int(shapes[0][1])
    if frozen.features != width:
        raise UserError(f"{bundle}: gives {frozen.features} features, the policy in {folder} takes {width}")
    actor = Actor(width, int(shapes[1][0]), int(shapes[0][0]))
    actor.load_state_dict(_part(tensors, "actor."))
    standardise: nn.Module = nn.Identity()
    if own_statistics := _part(tensors, "standardise."):
        standardise = StandardisedLatents(torch.zeros(width), torch.ones(width))
        standardise.load_state_dict(own_statistics)
    return OfflinePolicy(frozen, standardise, actor)


def _part(tensors: dict[str, Any], prefix: str) -> dict[str, Any]:
    return {name.removeprefix(prefix): value for name, value in tensors.items() if name.startswith(prefix)}
