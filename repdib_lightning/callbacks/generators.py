"""States of the random number generators as tensors and primitives, one record for each process of the run."""

from __future__ import annotations

import random
from typing import Any

import numpy as np
import torch
import torch.distributed as dist


def capture(device: torch.device) -> dict[str, Any]:
    """Return the states of Python's, numpy's (global), torch's CPU and, on a GPU, the device's generator."""
    legacy = np.random.get_state(legacy=False)  # noqa: NPY002
    assert isinstance(legacy, dict)
    states = {
        "python": random.getstate(),
        "numpy": {
            "key": torch.from_numpy(legacy["state"]["key"].astype(np.int64)),
            "position": int(legacy["state"]["pos"]),
            "has_gauss": int(legacy["has_gauss"]),
            "gauss": float(legacy["gauss"]),
        },
        "torch": torch.get_rng_state(),
    }
    if device.type == "cuda":
        states["cuda"] = torch.cuda.get_rng_state(device)
    return states


def restore(states: dict[str, Any], device: torch.device) -> None:
    """Inverse of :func:`capture`. A GPU's state is only put back on a GPU."""
    version, words, gauss = states["python"]
    random.setstate((version, tuple(words), gauss))
    legacy = states["numpy"]
    key = legacy["key"].numpy().astype(np.uint32)
    np.random.set_state(("MT19937", key, legacy["position"], legacy["has_gauss"], legacy["gauss"]))  # noqa: NPY002
    torch.set_rng_state(states["torch"].cpu())
    if device.type == "cuda" and "cuda" in states:
        torch.cuda.set_rng_state(states["cuda"].cpu(), device)


def gather(states: dict[str, Any], world_size: int) -> list[dict[str, Any]]:
    """Return the states of all processes, in order of rank. Every process must call this."""
    if world_size == 1:
        return [states]
    collected: list[Any] = [None] * world_size
    dist.all_gather_object(collected, states)
    return collected
