"""What an agent saw in its last evaluation, and what its critic thinks that it is worth."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from torch import Tensor

from repdib_lightning.data.files import whole_file

VALUES = "values.npz"
MOST_ROWS, _MOST_BYTES = 1000, 950_000


class SeenValues:
    """Latents and the values of the mean policy's actions, of every step of some episodes."""

    def __init__(self) -> None:
        self._latents: list[np.ndarray] = []
        self._values: list[np.ndarray] = []

    def add(self, latents: Tensor, values: Tensor) -> None:
        """Note (n, M) and (n,)."""
        self._latents.append(latents.cpu().numpy().astype(np.float16))
        self._values.append(values.cpu().numpy().astype(np.float32))

    def save(self, path: Path) -> None:
        """Write ``latents`` (n, M) float16 and ``values`` (n,) float32 of n rows, evenly spread over the episodes.

        n is 1000, or less where the file would be larger than a megabyte: 462 at M = 1024.
        """
        latents, values = np.concatenate(self._latents), np.concatenate(self._values)
        most = min(MOST_ROWS, _MOST_BYTES // (2 * latents.shape[1] + 4), len(latents))
        rows = np.linspace(0, len(latents) - 1, most).round().astype(int)
        with whole_file(path) as aside, open(aside, "wb") as file:
            np.savez_compressed(file, latents=latents[rows], values=values[rows])
