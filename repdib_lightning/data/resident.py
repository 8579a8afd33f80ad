"""Where rows are gathered from: the memory-mapped file, or a copy of the arrays on the training device."""

from __future__ import annotations

from pathlib import Path
from typing import Protocol

import numpy as np
import torch
from torch import Tensor

from repdib_lightning.data.episodes import EpisodeStore
from repdib_lightning.errors import UserError

PART_BYTES = 2**24
"""Size of the buffer through which a file is read onto a device."""
_MEMORY = Path("/proc/meminfo")


class Source(Protocol):
    """Gives rows of a store's arrays as tensors."""

    def gather(self, name: str, rows: np.ndarray) -> Tensor:
        """Copy the given rows of one key, in any order and with repeats: (n,) int64 -> (n, ...)."""


class Mapped:
    """Gathers from the file through memory maps: nothing is loaded but what a batch needs.

    Args:
        store: the data.
    """

    def __init__(self, store: EpisodeStore) -> None:
        self.store = store

    def gather(self, name: str, rows: np.ndarray) -> Tensor:
        """Copy the given rows of one key, in any order and with repeats: (n,) int64 -> (n, ...) on the CPU."""
        return torch.from_numpy(self.store.gather(name, rows))


class Resident:
    """Gathers from arrays that lie on a device as they are stored; they are loaded once, by the first gather.

    Args:
        store: the data.
        names: keys of the arrays to keep.
        device: where to keep them.
    """

    def __init__(self, store: EpisodeStore, names: list[str], device: torch.device) -> None:
        self.store, self.names, self.device = store, names, device
        self._arrays: dict[str, Tensor] = {}

    def gather(self, name: str, rows: np.ndarray) -> Tensor:
        """Copy the given rows of one key, in any order and with repeats: (n,) int64 -> (n, ...) on the device.

        Raises:
            UserError: at the first call, if the arrays do not fit the free memory of the device.
        """
        if not self._arrays:
            self._check_space()
            self._arrays = {name: self._load(name) for name in self.names}
        array = self._arrays[name]
        if self.device.type == "cpu":  # NumPy asks the system for large pages, torch does not: page faults cost more
            return torch.from_numpy(np.take(array.numpy(), rows, axis=0))
        return array.index_select(0, torch.from_numpy(rows).to(self.device))

    @property
    def bytes(self) -> int:
        """What the arrays take."""
        layouts = [self.store.layout(name) for name in self.names]
        return sum(int(np.prod(shape)) * dtype.itemsize for shape, dtype in layouts)

    def _check_space(self) -> None:
        free = free_memory(self.device)
        if free is not None and self.bytes > free:
            raise UserError(
                f"{self.store.path}: does not fit the memory of {self.device}: its arrays need "
                f"{self.bytes / 2**30:.3g} GiB, {free / 2**30:.3g} GiB are free; leave data.resident off"
            )

    def _load(self, name: str) -> Tensor:
        shape, dtype = self.store.layout(name)
        if self.device.type == "cpu":
            array = torch.from_numpy(np.empty(shape, dtype))
        else:
            array = torch.empty(shape, dtype=torch.from_numpy(np.empty(0, dtype)).dtype, device=self.device)
        first = 0
        for part in self.store.parts(name, PART_BYTES):
            array[first : first + len(part)] = torch.from_numpy(part)
            first += len(part)
        return array


def free_memory(device: torch.device) -> int | None:
    """Bytes that can be allocated on a device: CUDA and, where Linux tells it, the CPU; None if that is unknown."""
    if device.type == "cuda":
        return torch.cuda.mem_get_info(device)[0]
    if device.type == "cpu" and _MEMORY.is_file():
        for line in _MEMORY.read_text().splitlines():
            if line.startswith("MemAvailable:"):
                return int(line.split()[1]) * 1024
    return None
