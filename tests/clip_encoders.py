"""A small encoder of clips with a bottleneck for each modality."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import torch
from torch import Tensor, nn

from repdib_lightning.bottlenecks import RepDIB
from repdib_lightning.encoders.base import Encoder, EncoderOutput
from repdib_lightning.errors import UserError
from repdib_lightning.records import DataSpec

TOLD = ("acceleration", "gyroscope")


class PlainClips(Encoder):
    """The mean readings of two sensors, each through a layer and a bottleneck of its own, side by side.

    Args:
        spec: with the two sensors.
        features: M.
        codes: of each bottleneck.
        start_step: of each bottleneck.
        ready: whether it lets itself be exported.
    """

    def __init__(
        self, spec: DataSpec, *, features: int = 16, codes: int = 5, start_step: int = 0, ready: bool = True
    ) -> None:
        super().__init__(replace(spec, observations={name: spec.observations[name] for name in TOLD}), features)
        self.ready = ready
        self.layers = nn.ModuleDict({name: nn.Linear(6, features // 2) for name in TOLD})
        options: dict[str, Any] = {"groups": 2, "codes": codes, "start": "random", "start_step": start_step}
        self.bottlenecks = nn.ModuleDict({name: RepDIB(features // 2, **options) for name in TOLD})

    def forward(self, observations: dict[str, Tensor]) -> Tensor:
        return self.detailed(observations).features

    def detailed(self, observations: dict[str, Tensor]) -> EncoderOutput:
        found = {}
        for name in TOLD:
            seen = (observations[name] / 10.0 ** (TOLD.index(name) - 1)).nan_to_num().mean(1)
            found[name] = self.bottlenecks[name](self.layers[name](seen))
        losses = {
            f"unimodal_{loss}": torch.stack([output.losses[loss] for output in found.values()]).mean()
            for loss in found[TOLD[0]].losses
        }
        present = torch.stack([observations[name].isfinite().any(-1).any(-1) for name in TOLD], 1).float()
        codes = {
            name: output.codes.where(present[:, place, None] > 0, -1)
            for place, (name, output) in enumerate(found.items())
            if output.codes is not None
        }
        return EncoderOutput(
            torch.cat([output.latent for output in found.values()], 1),
            losses,
            {"unimodal_present": present.mean()},
            codes,
            {"modalities": present / present.sum(1, keepdim=True).clamp_min(1)},
        )

    def require_ready(self) -> None:
        if not self.ready:
            raise UserError("PlainClips: is not ready")
