"""The latest training latents, kept until a codebook starts on them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor

from repdib_lightning.bottlenecks.precision import SinglePrecision
from repdib_lightning.processes import gather_rows


class Reservoir(SinglePrecision):
    """A ring of the last R rows of width M. The latest, because an encoder in training leaves old latents behind.

    Attributes:
        rows: (R, M), or (0, M) after :meth:`release`, so that checkpoints and bundles do not carry it.
        seen: () int64, rows added so far.
    """

    rows: Tensor
    seen: Tensor

    def __init__(self, capacity: int, width: int) -> None:
        super().__init__()
        self.register_buffer("rows", torch.zeros(capacity, width))
        self.register_buffer("seen", torch.zeros((), dtype=torch.int64))

    @torch.no_grad()
    def add(self, latent: Tensor) -> None:
        """Store the (N, M) of all processes, in place of the oldest rows: each process keeps the same."""
        capacity = len(self.rows)
        latent = gather_rows(latent)[-capacity:]
        places = (self.seen + torch.arange(len(latent), device=latent.device)) % capacity
        self.rows.index_copy_(0, places, latent.to(self.rows.dtype))
        self.seen += len(latent)

    def collect(self) -> Tensor:
        """The rows added so far, at most R: (R', M)."""
        return self.rows[: int(self.seen)]

    def release(self) -> None:
        """Forget the rows and free their memory."""
        self._resize(0)

    def _resize(self, capacity: int) -> None:
        # In place: whoever holds this buffer (distributed training does) must not keep the old memory alive.
        self.rows.data = self.rows.new_zeros(capacity, self.rows.shape[1])

    def _load_from_state_dict(self, state_dict: Mapping[str, Any], prefix: str, *rest: Any) -> None:
        saved = state_dict.get(prefix + "rows")
        if saved is not None and len(saved) != len(self.rows):
            self._resize(len(saved))
        super()._load_from_state_dict(state_dict, prefix, *rest)
