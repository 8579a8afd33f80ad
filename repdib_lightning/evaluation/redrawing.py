"""Pictures of a store, encoded and drawn again, whole and with groups of the latent edited."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch

from repdib_lightning.bottlenecks.group_edits import GroupLayout, layout_of
from repdib_lightning.data.episodes import EpisodeStore
from repdib_lightning.data.sampling import gather_stacks
from repdib_lightning.decoders import Decoder
from repdib_lightning.evaluation.features import encode_rows
from repdib_lightning.export.frozen import FrozenEncoder

_ROWS = 64


@dataclass(frozen=True)
class Redrawing:
    """Rows of a store through a frozen encoder, and its decoder to draw them with.

    Attributes:
        pictures: (n, C, H, W) uint8, what was encoded. latents: (n, M) float32. codes: (n, P * G) int64 or None.
        layout: of the groups. encoder, decoder: of one bundle.
        counted: (m, P * G) int64, the codes of more pictures, which tell how often each is used; None for those here.
    """

    pictures: np.ndarray
    latents: np.ndarray
    codes: np.ndarray | None
    layout: GroupLayout
    encoder: FrozenEncoder
    decoder: Decoder
    counted: np.ndarray | None = None

    def draw(self, latents: np.ndarray | None = None) -> np.ndarray:
        """Draw (n, M), those of the rows by default, as (n, C, H, W) uint8."""
        latents = self.latents if latents is None else latents
        device = self.encoder.device
        drawn = np.empty((len(latents), *self.pictures.shape[1:]), np.uint8)
        with torch.inference_mode():
            for start in range(0, len(latents), _ROWS):
                part = torch.from_numpy(latents[start : start + _ROWS]).to(device)
                shares = self.decoder(part).float().clamp(0.0, 1.0)
                drawn[start : start + _ROWS] = shares.mul(255.0).round().to(torch.uint8).cpu().numpy()
        return drawn

    def with_code(self, group: int, code: int) -> np.ndarray:
        """Latents (n, M) whose group has one code, at all positions. Only where something is quantised."""
        assert self.codes is not None
        codes = self.codes.copy()
        self.layout.codes(codes)[:, :, group] = code
        return self.encoder.decode(codes).cpu().numpy()


def redraw(
    encoder: FrozenEncoder, decoder: Decoder, store: EpisodeStore, rows: np.ndarray, groups: int | None = None
) -> Redrawing:
    """Encode (n,) rows of a store.

    Args:
        encoder, decoder: of one bundle, on one device.
        store: holds what the encoder takes.
        rows: (n,) int64.
        groups: G to cut an unquantised latent into.

    Raises:
        UserError: see :func:`~repdib_lightning.bottlenecks.group_edits.layout_of`.
    """
    layout = layout_of(encoder.features, encoder.encoder.positions, encoder.groups, groups)
    latents, codes = encode_rows(encoder, store, rows, device=encoder.device, progress=False)
    pictures = gather_stacks(store, decoder.view, rows, encoder.spec.frame_stack)
    return Redrawing(pictures, latents, codes, layout, encoder, decoder)


def psnr(drawn: np.ndarray, pictures: np.ndarray) -> float:
    """10 log10(1 / MSE) in dB of (n, C, H, W) uint8 on the scale from 0 to 1, the error over all pictures together.

    At most 100 dB, which is also that of equal pictures.
    """
    squared = 0.0
    for start in range(0, len(drawn), _ROWS):
        part = slice(start, start + _ROWS)
        apart = (drawn[part].astype(np.float32) - pictures[part].astype(np.float32)) / 255.0
        squared += float(np.sum(np.square(apart), dtype=np.float64))
    return float(-10.0 * np.log10(max(squared / pictures.size, 1e-10)))
