"""What offline agents see of a store: latents of a frozen encoder, each frame encoded once; or the pictures."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from repdib_lightning.data.episodes import EpisodeStore
from repdib_lightning.data.sampling import gather_stacks
from repdib_lightning.encoders.augmentation import random_shift
from repdib_lightning.evaluation.features import check_compatible, encode_rows
from repdib_lightning.export.frozen import FrozenEncoder
from repdib_lightning.records import DataSpec


class Latents:
    """Latents of every training row, encoded once.

    Args:
        store: the data.
        encoder: on the device that encodes.
        copies: how often each frame is encoded: once as it is, and further times randomly shifted; a batch draws one of
            these for each row.
        shift: largest shift in pixels.
        seed: of the shifts.
        progress: show a progress bar.

    Attributes:
        mean, deviation: (M,) of the latents, over the training rows.

    Raises:
        UserError: the store lacks what the encoder takes, or the encoder returns NaN.
    """

    def __init__(
        self,
        store: EpisodeStore,
        encoder: FrozenEncoder,
        *,
        copies: int = 1,
        shift: int = 4,
        seed: int = 0,
        progress: bool = True,
    ) -> None:
        check_compatible(encoder, store, "the encoder")
        episodes = store.episodes("train")
        parts = [np.arange(store.starts[e], store.starts[e] + store.lengths[e]) for e in episodes]
        rows = np.concatenate(parts)
        self._place = np.full(store.rows, -1)
        self._place[rows] = np.arange(len(rows))
        torch.manual_seed(seed)
        encoded = []
        for copy in range(copies):
            seen = encoder if copy == 0 else _Shifted(encoder, shift)
            encoded.append(encode_rows(seen, store, rows, device=encoder.device, progress=progress)[0])
        self.copies = encoded[0][None] if copies == 1 else np.stack(encoded)
        # By torch, whose running sums stay exact over many rows, also where a dimension never varies.
        self.deviation, self.mean = torch.std_mean(torch.from_numpy(self.copies), (0, 1), correction=0)

    def rows(self, rows: np.ndarray, random: np.random.Generator) -> Tensor:
        """(n,) rows to (n, M)."""
        places = self._place[rows]
        assert (places >= 0).all(), "only training rows are encoded"
        copy = random.integers(len(self.copies), size=len(rows))
        return torch.from_numpy(self.copies[copy, places])


class Pictures:
    """Observations of rows, stacked, for an encoder that is trained; shifted there, on the training device.

    Args:
        store: the data. spec: of the encoder.
    """

    def __init__(self, store: EpisodeStore, spec: DataSpec) -> None:
        self._store, self._spec = store, spec

    def rows(self, rows: np.ndarray, random: np.random.Generator) -> dict[str, Tensor]:
        """(n,) rows to name -> (n, *shape)."""
        stack, names = self._spec.frame_stack, self._spec.observations
        return {name: torch.from_numpy(gather_stacks(self._store, name, rows, stack)) for name in names}


class _Shifted:
    """A frozen encoder whose pictures are randomly shifted first."""

    def __init__(self, encoder: FrozenEncoder, shift: int) -> None:
        self._encoder, self._shift = encoder, shift
        self.features, self.groups, self.codes_per_group = encoder.features, encoder.groups, encoder.codes_per_group
        self.spec = encoder.spec

    def encode(self, observations: dict[str, Tensor], /) -> Tensor:
        """Shift, then encode: name -> (N, *shape) to (N, M)."""
        return self._encoder.encode({name: self._moved(array) for name, array in observations.items()})

    def encode_with_codes(self, observations: dict[str, Tensor], /) -> tuple[Tensor, Tensor]:
        """Shift, then encode into latents and codes."""
        return self._encoder.encode_with_codes({name: self._moved(array) for name, array in observations.items()})

    def _moved(self, array: Tensor) -> Tensor:
        return random_shift(array, self._shift) if array.dtype == torch.uint8 and array.ndim == 4 else array
