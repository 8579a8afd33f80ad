"""Batches of windows: what is seen, done and reached, gathered at once, on the device that trains."""

from __future__ import annotations

import mmap
import warnings
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import torch
from torch import Tensor

from repdib_lightning.data.episodes import EpisodeStore
from repdib_lightning.rl.decision_transformer.windows import WindowOrder, Windows

IGNORED = -100
"""Target of padding, which torch's cross-entropy leaves out."""

Seen = Tensor | dict[str, Tensor]
"""Latents (B, T, M) or codes (B, T, G); or pictures, name -> (B, S - 1 + T, C, H, W), of S to a stack."""


@dataclass
class WindowBatch:
    """Attributes: seen: see :data:`Seen`. returns: (B, T) float32, to go. actions: (B, T) int64. targets: (B, T) int64,
    the actions, :data:`IGNORED` in padding. first: (B,) int64, time step of the first step. steps: number of those that
    are no padding, of the whole batch."""

    seen: Seen
    returns: Tensor
    actions: Tensor
    targets: Tensor
    first: Tensor
    steps: int

    def __len__(self) -> int:
        return len(self.first)

    def part(self, places: slice) -> WindowBatch:
        """Some of the windows; ``steps`` stays that of the whole batch."""
        seen = self.seen
        cut = {n: a[places] for n, a in seen.items()} if isinstance(seen, dict) else seen[places]
        columns = (self.returns[places], self.actions[places], self.targets[places], self.first[places])
        return WindowBatch(cut, *columns, self.steps)


class SeenSource(Protocol):
    """Where what is seen in windows comes from."""

    def gather(self, windows: np.ndarray, rows: Tensor) -> Seen:
        """What is seen in windows, (B,) int64, whose steps are ``rows``, (B, T) int64 on the device."""
        ...


class VectorTable:
    """Vectors of all rows of an encoded store, as one tensor: mapped from the file on a CPU, else on the device.

    Args:
        store: made by :func:`~repdib_lightning.evaluation.encoded_store.encode_store`. name: of the observation.
        whole: whether these are whole numbers, such as codes. device: that trains.
    """

    def __init__(self, store: EpisodeStore, name: str, *, whole: bool, device: torch.device) -> None:
        with warnings.catch_warnings():  # of an array that cannot be written to: nobody does
            warnings.simplefilter("ignore", UserWarning)
            vectors = torch.from_numpy(store.array(f"observations/{name}")[:])
        self.vectors = vectors.to(device, torch.int64 if whole else torch.float32)

    def gather(self, windows: np.ndarray, rows: Tensor) -> Tensor:
        """(B, T, M) at rows (B, T)."""
        return self.vectors.index_select(0, rows.flatten()).unflatten(0, tuple(rows.shape))


class PictureFrames:
    """Un-stacked pictures of the windows' rows: each is read once, and stacked on the device.

    Args:
        store: the data. windows: of it. names: of the pictures. frame_stack: S. device: that trains.
    """

    def __init__(
        self, store: EpisodeStore, windows: Windows, names: list[str], frame_stack: int, device: torch.device
    ) -> None:
        self._store, self._windows, self._names = store, windows, names
        self._stack, self._device = frame_stack, device

    def gather(self, windows: np.ndarray, rows: Tensor) -> dict[str, Tensor]:
        """Name -> (B, S - 1 + T, C, H, W) uint8."""
        wanted = self._windows.stacked_rows(windows, self._stack)
        found = {}
        for name in self._names:
            frames = torch.from_numpy(self._store.gather(f"observations/{name}", wanted.reshape(-1)))
            found[name] = frames.unflatten(0, wanted.shape).to(self._device)
            _give_back(self._store.array(f"observations/{name}"))
        return found


def _give_back(array: object) -> None:
    """Forget which pages of a mapped file were read, else the whole file counts as this process's memory in the end.

    They stay in the system's cache as long as there is room: reading them again costs next to nothing.
    """
    mapped = getattr(array, "base", None)
    if isinstance(mapped, mmap.mmap):
        mapped.madvise(mmap.MADV_DONTNEED)


def stacked_frames(frames: Tensor, frame_stack: int) -> Tensor:
    """(B, S - 1 + T, C, H, W) to the stack of each step, oldest first: (B * T, S * C, H, W)."""
    steps = frames.shape[1] - frame_stack + 1
    shifted = [frames[:, ago : ago + steps] for ago in range(frame_stack)]
    return torch.cat(shifted, dim=2).flatten(0, 1)


class WindowBatches:
    """The batches of a training, from any of them on.

    Args:
        windows: of the data. source: what is seen. order: which windows. epochs: how many. device: that trains.

    Attributes:
        first: number of the batch to begin with.
    """

    def __init__(
        self, windows: Windows, source: SeenSource, order: WindowOrder, epochs: int, device: torch.device
    ) -> None:
        self.windows, self.source, self.order = windows, source, order
        self.total, self.first, self._device = epochs * order.batches, 0, device
        self._returns = torch.from_numpy(windows.returns).to(device)
        self._actions = torch.from_numpy(windows.actions).to(device)
        self._places = torch.arange(windows.context, device=device)

    def __len__(self) -> int:
        """Batches that are left."""
        return self.total - self.first

    def __iter__(self) -> Iterator[WindowBatch]:
        for number in range(self.first, self.total):
            yield self.batch(number)

    @property
    def tokens(self) -> float:
        """Steps that are no padding in an epoch, where windows are drawn evenly."""
        return float(self.windows.lengths.mean()) * self.order.samples

    def batch(self, number: int) -> WindowBatch:
        """One batch."""
        windows = self.order.batch(number)
        rows = torch.from_numpy(self.windows.rows(windows)).to(self._device)
        lengths = self.windows.lengths[windows]
        padding = self._places >= torch.from_numpy(lengths).to(self._device).unsqueeze(1)
        actions = self._actions[rows]
        return WindowBatch(
            self.source.gather(windows, rows),
            self._returns[rows],
            actions,
            actions.masked_fill(padding, IGNORED),
            torch.from_numpy(self.windows.timesteps[windows]).to(self._device),
            int(lengths.sum()),
        )
