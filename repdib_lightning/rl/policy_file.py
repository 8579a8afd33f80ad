"""A trained offline policy as a file of tensors, and as a function of observations."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor, nn

from repdib_lightning.data.files import whole_file
from repdib_lightning.errors import UserError
from repdib_lightning.export.frozen import FrozenEncoder
from repdib_lightning.export.load import load_encoder
from repdib_lightning.export.observations import Observations
from repdib_lightning.rl.networks import Actor, StandardisedLatents
from repdib_lightning.rl.offline_options import OfflineOptions

POLICY = "policy.safetensors"

T = TypeVar("T")


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
    trained_on, (standardise, actor) = read_policy(
        Path(folder), "td3bc or bc", lambda facts, tensors: (facts["encoder"], _rebuilt(tensors))
    )
    bundle = bundle_of_policy(Path(folder), trained_on, encoder)
    frozen = load_encoder(bundle)
    if frozen.features != actor.features:
        raise UserError(f"{bundle}: gives {frozen.features} features, the policy in {folder} takes {actor.features}")
    return OfflinePolicy(frozen, standardise, actor)


def read_policy(folder: Path, agents: str, rebuild: Callable[[Any, dict[str, Tensor]], T]) -> T:
    """Read a run's ``policy.safetensors``.

    Args:
        folder: of the run. agents: who writes such a file, for messages.
        rebuild: what to make of its facts and tensors; it may raise what a dictionary or torch raises.

    Raises:
        UserError: no such run, or a file that ``rebuild`` can make nothing of.
    """
    path = folder / POLICY
    if not path.is_file():
        raise UserError(f"{folder}: holds no {POLICY}; name the folder of a finished run of finetune {agents}")
    try:
        with safe_open(path, framework="pt") as file:
            facts = json.loads((file.metadata() or {})["policy"])
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 (not a dictionary)
        return rebuild(facts, tensors)
    except (SafetensorError, KeyError, ValueError, OSError, RuntimeError, TypeError) as error:
        reason = str(error).splitlines()[0]
        raise UserError(f"{path}: not a policy of finetune {agents} ({type(error).__name__}: {reason})") from error


def bundle_of_policy(folder: Path, trained_on: str | None, given: str | Path | None) -> Path:
    """The encoder of a run's policy: the given one, else the one that it was trained on, else the run's own.

    Raises:
        UserError: the run should have one, and has not.
    """
    own = folder / "bundle"
    if given is None and trained_on is None and not own.is_dir():
        raise UserError(f"{folder}: its encoder, {own}, is missing; put it back, or name one")
    named = Path(given or (trained_on if trained_on is not None else own))
    return named / "bundle" if (named / "bundle").is_dir() else named


def _rebuilt(tensors: dict[str, Tensor]) -> tuple[nn.Module, Actor]:
    """Standardiser and actor; whatever a dictionary or torch raises where tensors are missing or too many."""
    hidden, width = tensors["actor.network.0.weight"].shape
    actor = Actor(width, len(tensors["actor.network.4.bias"]), hidden)
    actor.load_state_dict(_part(tensors, "actor."))
    standardise: nn.Module = nn.Identity()
    if statistics := _part(tensors, "standardise."):
        standardise = StandardisedLatents(torch.zeros(width), torch.ones(width))
        standardise.load_state_dict(statistics)
    return standardise, actor


def _part(tensors: dict[str, Tensor], prefix: str) -> dict[str, Tensor]:
    return {name.removeprefix(prefix): value for name, value in tensors.items() if name.startswith(prefix)}
