"""An encoder and its bottleneck as the features of a Stable-Baselines3 policy, trained together with it."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import gymnasium
import torch
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from torch import Tensor

from repdib_lightning.export.rebuild import rebuild
from repdib_lightning.loss_weights import DEFAULT_LOSS_WEIGHTS
from repdib_lightning.rl.ride_along import ride_along


class BottleneckFeatures(BaseFeaturesExtractor):
    """Observations through encoder and bottleneck to (N, M); the losses of the bottleneck ride along.

    In training mode the Gaussian draws noise and running codebooks follow; in evaluation mode (rollouts, the target
    network) it is deterministic. Takes observations as
    :class:`~repdib_lightning.export.gymnasium_wrapper.PrepareObservation` gives them; the policy needs
    ``normalize_images=False``, since scaling is the encoder's.

    Args:
        observation_space: a ``Dict`` space of the encoder's observations.
        description: of the two modules, as in a bundle's ``config.json``: plain, so that a saved policy needs no other
            file. The weights start random.
        bottleneck_losses: weight of kl (x 0.01), commitment (x 0.25) and codebook (x 1) together; 0 leaves them out.
    """

    def __init__(
        self, observation_space: gymnasium.Space[Any], description: Mapping[str, Any], bottleneck_losses: float = 1.0
    ) -> None:
        super().__init__(observation_space, int(description["features"]))
        self.encoder, self.bottleneck = rebuild(Path("the policy's description"), description)
        self.bottleneck_losses = bottleneck_losses
        self.latest: dict[str, Tensor] = {}

    def forward(self, observations: dict[str, Tensor]) -> Tensor:
        """Encode name -> (N, *shape) into (N, M)."""
        output = self.bottleneck(self.encoder(observations))
        if not self.training:
            return output.latent
        self.latest = {name: value.detach() for name, value in (output.losses | output.metrics).items()}
        if not output.losses or self.bottleneck_losses == 0.0:
            return output.latent
        terms = [DEFAULT_LOSS_WEIGHTS.get(name, 1.0) * value for name, value in output.losses.items()]
        return ride_along(output.latent, self.bottleneck_losses * torch.stack(terms).sum())
