"""What an online agent sees with: a frozen encoder, or one that it trains; from a snapshot, a bundle, or fresh."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from repdib_lightning.bottlenecks import Identity
from repdib_lightning.bottlenecks.base import Bottleneck
from repdib_lightning.encoders import ConvolutionalEncoder
from repdib_lightning.encoders.augmentation import random_shift
from repdib_lightning.encoders.base import Encoder
from repdib_lightning.export.description import CONFIG
from repdib_lightning.export.frozen import FrozenEncoder
from repdib_lightning.export.load import load_encoder
from repdib_lightning.export.rebuild import rebuild
from repdib_lightning.loss_weights import DEFAULT_LOSS_WEIGHTS
from repdib_lightning.records import ArraySpec, DataSpec
from repdib_lightning.rl.exploration.snapshots import AgentFile, find_snapshot, read_agent
from repdib_lightning.rl.given_bundle import checked_bundle
from repdib_lightning.rl.online_options import OnlineOptions
from repdib_lightning.rl.ride_along import ride_along

VIEW = "pixels"
"""What a fresh encoder calls the picture that it sees."""


@dataclass(frozen=True)
class Given:
    """What the user named with ``--encoder``.

    Attributes:
        bundle: its folder; None for a fresh encoder. encoder: loaded, frozen.
        agent: the one that explored; None of a bundle without one.
    """

    bundle: Path | None = None
    encoder: FrozenEncoder | None = None
    agent: AgentFile | None = None
    facts: Mapping[str, Any] = field(default_factory=dict)


def given_encoder(options: OnlineOptions) -> Given:
    """Load what ``--encoder``, ``--snapshot`` and ``--bottleneck`` name.

    Raises:
        UserError: no such snapshot or bundle, or a damaged one.
    """
    if options.encoder is None:
        return Given()
    bundle = checked_bundle(find_snapshot(options.encoder, options.snapshot))
    assert bundle is not None
    encoder, agent = load_encoder(bundle), read_agent(bundle)
    if not options.bottleneck:
        encoder = FrozenEncoder(encoder.encoder, Identity(encoder.features), encoder.description)
    return Given(bundle, encoder, agent, {} if agent is None else agent.facts)


def trained_parts(options: OnlineOptions, given: Given, picture: tuple[int, ...]) -> tuple[Encoder, Bottleneck]:
    """An encoder and a bottleneck that an agent can train: those of a bundle, or fresh ones.

    Args:
        options: of a fresh encoder. given: see there. picture: (3, H, W) that the task shows.
    """
    if given.encoder is None or given.bundle is None:
        stack = options.fresh("frame_stack")
        spec = DataSpec({VIEW: ArraySpec((picture[0] * stack, *picture[1:]))}, frame_stack=stack)
        torch.manual_seed(options.seed)
        sizes = {name: options.fresh(name) for name in ("features", "channels", "strides")}
        return ConvolutionalEncoder(spec, **sizes), Identity(sizes["features"])
    encoder, bottleneck = rebuild(given.bundle / CONFIG, given.encoder.description)
    encoder.load_state_dict(given.encoder.encoder.state_dict())
    if not options.bottleneck:
        return encoder, Identity(encoder.features)
    bottleneck.load_state_dict(given.encoder.bottleneck.state_dict())
    return encoder, bottleneck


class TrainedFeatures(nn.Module):
    """Pictures through encoder and bottleneck to (B, M), trained by the critic's loss (DrQ-v2, Yarats et al. 2021).

    In training mode pictures are randomly shifted, and the losses of the bottleneck ride along.

    Args:
        encoder, bottleneck: both are trained. shift: largest shift in pixels.
        losses_weight: of kl (x 0.01), commitment (x 0.25) and codebook (x 1) together; 0 leaves them out.

    Attributes:
        latest: what the bottleneck told of the last training pass.
    """

    def __init__(self, encoder: Encoder, bottleneck: Bottleneck, shift: int, losses_weight: float) -> None:
        super().__init__()
        self.encoder, self.bottleneck = encoder, bottleneck
        self.shift, self.losses_weight = shift, losses_weight
        self.latest: dict[str, Tensor] = {}

    def forward(self, observations: Mapping[str, Tensor]) -> Tensor:
        """Name -> (B, *shape) to (B, M)."""
        if not self.training:
            return evaluated(self.encoder, self.bottleneck, dict(observations))
        output = self.bottleneck(self.encoder(self._shifted(observations)))
        self.latest = {name: value.detach() for name, value in (output.losses | output.metrics).items()}
        latent: Tensor = output.latent
        if not output.losses or self.losses_weight == 0.0:
            return latent
        terms = [DEFAULT_LOSS_WEIGHTS.get(name, 1.0) * value for name, value in output.losses.items()]
        return ride_along(latent, self.losses_weight * torch.stack(terms).sum())

    def later(self, observations: Mapping[str, Tensor]) -> Tensor:
        """The same of what is bootstrapped from: shifted, but without noise, and running codebooks stay."""
        return evaluated(self.encoder, self.bottleneck, self._shifted(observations))

    def _shifted(self, observations: Mapping[str, Tensor]) -> dict[str, Tensor]:
        return {name: random_shift(array, self.shift) for name, array in observations.items()}


@torch.no_grad()
def evaluated(encoder: nn.Module, bottleneck: nn.Module, observations: dict[str, Tensor]) -> Tensor:
    """(B, M) of an encoder and a bottleneck in evaluation mode, whatever mode they are in before and after."""
    trained = [module for part in (encoder, bottleneck) for module in part.modules() if module.training]
    for module in trained:
        module.training = False
    latent: Tensor = bottleneck(encoder(observations)).latent
    for module in trained:
        module.training = True
    return latent
