"""The device that something runs on, by its name."""

from __future__ import annotations

import torch

from repdib_lightning.errors import UserError, nearest


def resolve_device(device: str) -> torch.device:
    """``auto`` is the first CUDA device if there is one, else the CPU.

    Raises:
        UserError: an unknown device, or one that this machine lacks.
    """
    if device == "auto":
        return torch.device("cuda" if torch.cuda.is_available() else "cpu")
    try:
        chosen = torch.device(device)
        torch.empty(1, device=chosen)
    except (RuntimeError, AssertionError, NotImplementedError) as error:
        choices = ["auto", "cpu"] + (["cuda"] if torch.cuda.is_available() else [])
        raise UserError(f"device '{device}' cannot be used here, {nearest(device, choices)}") from error
    return chosen
