"""A trained Decision Transformer as a file of tensors, and as something that acts in one's own loop."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path
from typing import Any

import torch
from safetensors.torch import save_file
from torch import Tensor, nn

from repdib_lightning.data.files import whole_file
from repdib_lightning.devices import resolve_device
from repdib_lightning.errors import UserError
from repdib_lightning.export.frozen import FrozenEncoder
from repdib_lightning.export.load import load_encoder
from repdib_lightning.export.observations import Observations
from repdib_lightning.rl.decision_transformer.network import DecisionTransformer, Sizes
from repdib_lightning.rl.decision_transformer.play import Play
from repdib_lightning.rl.decision_transformer.states import CodeStates, EncodedStates, LatentStates
from repdib_lightning.rl.policy_file import POLICY, bundle_of_policy, read_policy


class DecisionTransformerPolicy:
    """A frozen encoder and a Decision Transformer.

    ``play = policy.begin(target_return=90)`` begins an episode; ``play.act(observation)`` gives its first action, and
    ``play.act(observation, reward)`` every later one: see :class:`~repdib_lightning.rl.decision_transformer.play.Play`.

    Attributes:
        encoder: what :func:`~repdib_lightning.export.load_encoder` returned. network: in evaluation mode.
        target_return, temperature: of its training's evaluation.
    """

    def __init__(
        self, encoder: FrozenEncoder, network: DecisionTransformer, target_return: float, temperature: float
    ) -> None:
        self.encoder, self.network = encoder, network.eval()
        self.target_return, self.temperature = target_return, temperature

    def begin(
        self,
        *,
        episodes: int = 1,
        target_return: float | None = None,
        temperature: float | None = None,
        seed: int = 0,
    ) -> Play:
        """Begin episodes that are played in step.

        Args:
            episodes: n. target_return, temperature: by default those of the evaluation. seed: of the actions drawn.
        """
        return Play(
            self.network,
            lambda observations: states_of(self.encoder, self.network, observations),
            episodes=episodes,
            target_return=self.target_return if target_return is None else target_return,
            temperature=self.temperature if temperature is None else temperature,
            seed=seed,
        )


def states_of(encoder: FrozenEncoder, network: DecisionTransformer, observations: Observations) -> Tensor:
    """What a network takes as states, of an encoder: latents (n, M), or codes (n, G)."""
    return encoder.codes(observations) if isinstance(network.states, CodeStates) else encoder.encode(observations)


def save_decision_transformer(
    folder: Path, network: DecisionTransformer, encoder: Path | None, target_return: float, temperature: float
) -> None:
    """Write ``policy.safetensors``: the network, its sizes, and where its encoder is; None for the run's own bundle."""
    states = network.states
    facts: dict[str, Any] = {
        "agent": "dt",
        "encoder": None if encoder is None else str(encoder),
        "sizes": asdict(network.sizes),
        "states": type(states).__name__,
        "groups": len(states.offsets) if isinstance(states, CodeStates) else 0,
        "target_return": target_return,
        "temperature": temperature,
    }
    tensors = {name: value.detach().cpu().contiguous() for name, value in network.state_dict().items()}
    with whole_file(folder / POLICY) as aside:
        save_file(tensors, aside, {"policy": json.dumps(facts)})


def load_decision_transformer(
    folder: str | Path, encoder: str | Path | None = None, device: str = "cpu"
) -> DecisionTransformerPolicy:
    """Load what ``finetune dt`` trained.

    Args:
        folder: of that run.
        encoder: the bundle; by default the run's own, or the one that it was trained on.
        device: cpu, cuda, or auto.

    Raises:
        UserError: no such run or bundle, a damaged file, or a bundle that gives something else.
    """

    def rebuild(facts: Any, tensors: dict[str, Tensor]) -> tuple[str | None, DecisionTransformer, float, float]:
        return facts["encoder"], _rebuilt(facts, tensors), float(facts["target_return"]), float(facts["temperature"])

    trained_on, network, *acts = read_policy(Path(folder), "dt", rebuild)
    bundle = bundle_of_policy(Path(folder), trained_on, encoder)
    frozen = load_encoder(bundle)
    _check_fits(bundle, frozen, Path(folder), network)
    chosen = resolve_device(device)
    return DecisionTransformerPolicy(frozen.to(chosen), network.to(chosen), *acts)


def _rebuilt(facts: dict[str, Any], tensors: dict[str, Tensor]) -> DecisionTransformer:
    """The network; whatever a dictionary or torch raises where something is missing or too much."""
    sizes = Sizes(**facts["sizes"])
    states: nn.Module = EncodedStates()
    if facts["states"] == LatentStates.__name__:
        width = tensors["states.linear.weight"].shape[1]
        states = LatentStates(torch.zeros(width), torch.ones(width), sizes.width)
    elif facts["states"] == CodeStates.__name__:
        groups = int(facts["groups"])
        states = CodeStates(groups, len(tensors["states.codes.weight"]) // groups, sizes.width)
    network = DecisionTransformer(sizes, states)
    network.load_state_dict(tensors)
    return network


def _check_fits(bundle: Path, encoder: FrozenEncoder, folder: Path, network: DecisionTransformer) -> None:
    states = network.states
    if isinstance(states, CodeStates):
        wanted = f"{len(states.offsets)} groups of {states.codes.num_embeddings // len(states.offsets)} codes"
        given = f"{encoder.groups} groups of {encoder.codes_per_group} codes"
    else:
        width = states.linear.in_features if isinstance(states, LatentStates) else network.sizes.width
        wanted, given = f"{width} features", f"{encoder.features} features"
    if wanted != given:
        raise UserError(f"{bundle}: gives {given}, the policy in {folder} takes {wanted}")
