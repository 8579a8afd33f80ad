"""Reconstruction: draw the picture again from its latent."""

from __future__ import annotations

from collections.abc import Callable

import torch
import torch.nn.functional as F
from torch import Tensor

from repdib_lightning.decoders import Decoder, ResidualDecoder
from repdib_lightning.objectives.base import Encode, Objective
from repdib_lightning.records import Batch, DataSpec, ObjectiveOutput


class Reconstruction(Objective):
    """Mean squared error of the picture that a decoder draws from the latent (paper, PACS: MSE and the quantiser's
    losses).

    Every frame of a sample is drawn; set ``data.futures`` to 0 where the anchor alone will do. Pictures are compared on
    the scale from 0 to 1, as they are in the data: random shifts (``model.shift``) would have to be guessed.

    Losses: ``reconstruction``, the mean over samples, channels and pixels. Metrics: ``psnr`` in dB, 10 log10(1 / MSE),
    of the batch, with the drawing clipped to what a picture can show.

    Args:
        width: M.
        spec: of the data.
        decoder: builds the decoder from the spec and the width.
    """

    decoder: Decoder

    def __init__(
        self, width: int, spec: DataSpec, *, decoder: Callable[[DataSpec, int], Decoder] = ResidualDecoder
    ) -> None:
        super().__init__()
        self.decoder = decoder(spec, width)

    def forward(self, batch: Batch, encode: Encode) -> ObjectiveOutput:
        """Encode (B, F) frames and draw them."""
        latents = encode(batch.observations)
        wanted = as_shares(batch.observations[self.decoder.view].flatten(0, 1), latents.dtype)
        drawn = self.decoder(latents.flatten(0, 1))
        loss = F.mse_loss(drawn, wanted)
        with torch.no_grad():
            psnr = -10.0 * torch.log10(F.mse_loss(drawn.clamp(0.0, 1.0), wanted).clamp_min(1e-10))
        return ObjectiveOutput({"reconstruction": loss}, {"psnr": psnr})


def as_shares(pictures: Tensor, dtype: torch.dtype) -> Tensor:
    """(N, C, H, W) uint8 as floating-point numbers from 0 to 1."""
    return pictures.to(dtype).div_(255.0)
