"""A trained encoder and its bottleneck behind one small interface, for probes and agents."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from repdib_lightning.bottlenecks.base import Bottleneck
from repdib_lightning.encoders.base import Encoder, EncoderOutput
from repdib_lightning.errors import UserError
from repdib_lightning.export.observations import Observations, batched_observations
from repdib_lightning.records import DataSpec


class FrozenEncoder(nn.Module):
    """Encodes observations to latents and codes; cannot be trained by accident.

    It stays in evaluation mode (``train()`` does not leave it), no parameter asks for a gradient, and nothing is
    recorded for one. The same observation gives the same latent every time, whatever else is in the batch, up to the
    rounding of the batched product.

    Observations are a map name -> array (numpy or torch), or the bare array where the spec has one observation;
    (N, *shape), or (*shape), which gives an un-batched result. Pictures are uint8 and channels first.

    Attributes:
        spec: the observations it takes.
        features: M.
        groups: G, or 0 where nothing is quantised.
        codes_per_group: L, or 0 where nothing is quantised.
        description: the bundle's ``config.json``: classes, versions, facts of data and training.
    """

    def __init__(self, encoder: Encoder, bottleneck: Bottleneck, description: Mapping[str, Any]) -> None:
        super().__init__()
        self.encoder = encoder
        self.bottleneck = bottleneck
        self.description = dict(description)
        self.spec: DataSpec = encoder.spec
        self.features: int = encoder.features
        self.groups: int = bottleneck.groups
        self.codes_per_group: int = bottleneck.codes
        self.requires_grad_(False)
        self.train(False)

    def train(self, mode: bool = True) -> FrozenEncoder:
        """Stay in evaluation mode, also when an agent that holds this module goes to training mode."""
        super().train(False)
        return self

    @property
    def device(self) -> torch.device:
        """Where the weights are; observations are moved there."""
        return next(self.parameters()).device

    def forward(self, observations: Observations) -> Tensor:
        """Same as :meth:`encode`."""
        return self.encode(observations)

    def encode(self, observations: Observations) -> Tensor:
        """Encode into (N, M) float32, or (M,) without a batch axis. Raises UserError as the class says."""
        return self._run(observations)[0]

    @torch.no_grad()
    def detailed(self, observations: Observations) -> EncoderOutput:
        """The latent as ``features``, with what is inside the encoder: codes and attention of its modalities, metrics.

        Losses are left out. Raises UserError as the class says.
        """
        tensors, is_batched = batched_observations(observations, self.spec, self.device)
        if is_batched and not all(map(len, tensors.values())):
            return EncoderOutput(torch.empty(0, self.features, device=self.device))
        with torch.autocast(self.device.type, enabled=False):
            seen = self.encoder.detailed(tensors)
            latent: Tensor = self.bottleneck(seen.features).latent
        inside = [seen.codes, seen.attention]
        if not is_batched:
            latent, inside = latent[0], [{name: part[0] for name, part in parts.items()} for parts in inside]
        return EncoderOutput(latent, metrics=seen.metrics, codes=inside[0], attention=inside[1])

    def codes(self, observations: Observations) -> Tensor:
        """Encode into (N, G) int64 in [0, L), or (G,) without a batch axis.

        Raises:
            UserError: the bottleneck does not quantise, or the observations do not fit.
        """
        return self.encode_with_codes(observations)[1]

    def encode_with_codes(self, observations: Observations) -> tuple[Tensor, Tensor]:
        """Latent and codes in one pass: (N, M) and (N, G). Raises UserError as :meth:`codes` does."""
        self._check_quantised()
        latent, codes = self._run(observations)
        assert codes is not None, "a bottleneck with groups returns codes in evaluation mode"
        return latent, codes

    @torch.no_grad()
    def decode(self, codes: Tensor | np.ndarray[Any, Any]) -> Tensor:
        """Map (N, G) or (G,) indices to the (N, M) or (M,) latent that they stand for.

        Raises:
            UserError: the bottleneck does not quantise, or indices of a wrong shape, type or range.
        """
        self._check_quantised()
        if isinstance(codes, np.ndarray) and codes.dtype.kind in "biufc":
            codes = torch.from_numpy(np.require(codes, requirements=["C", "W"]))
        if not isinstance(codes, Tensor):
            raise UserError(f"codes must be a numpy array of whole numbers or a tensor, are {_shown_type(codes)}")
        if codes.dim() not in (1, 2) or codes.shape[-1] != self.groups:
            raise UserError(f"codes have shape {tuple(codes.shape)}, expected (N, {self.groups}) or ({self.groups},)")
        if codes.is_floating_point() or codes.is_complex() or codes.dtype == torch.bool:
            raise UserError(f"codes must be whole numbers, are {codes.dtype}")
        codes = codes.to(self.device, torch.int64)
        if codes.numel() and not 0 <= int(codes.min()) <= int(codes.max()) < self.codes_per_group:
            raise UserError(f"codes must be in [0, {self.codes_per_group}), are in [{codes.min()}, {codes.max()}]")
        if not codes.numel():
            return torch.empty(0, self.features, device=self.device)
        latent = self.bottleneck.decode(codes.reshape(-1, self.groups))
        return latent.reshape(*codes.shape[:-1], self.features)

    @torch.no_grad()
    def _run(self, observations: Observations) -> tuple[Tensor, Tensor | None]:
        tensors, is_batched = batched_observations(observations, self.spec, self.device)
        # Here, since reshapes in encoders and quantisers cannot tell a size from no elements.
        if is_batched and not all(map(len, tensors.values())):
            codes = torch.empty(0, self.groups, dtype=torch.int64, device=self.device) if self.groups else None
            return torch.empty(0, self.features, device=self.device), codes
        # An agent's autocast must not change what its frozen encoder returns.
        with torch.autocast(self.device.type, enabled=False):
            output = self.bottleneck(self.encoder(tensors))
        if is_batched:
            return output.latent, output.codes
        return output.latent[0], None if output.codes is None else output.codes[0]

    def _check_quantised(self) -> None:
        if not self.groups:
            name = type(self.bottleneck).__name__
            raise UserError(f"this encoder has no codes: its bottleneck, {name}, quantises nothing")


def _shown_type(value: object) -> str:
    return f"an array of {value.dtype}" if isinstance(value, np.ndarray) else type(value).__name__
