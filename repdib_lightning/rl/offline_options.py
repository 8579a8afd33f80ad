"""The options of the offline agents, checked."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from repdib_lightning.errors import UserError
from repdib_lightning.rl.devices import check_device_name

NO_ENVIRONMENT = "none"
FRESH = {"features": 256, "channels": 32, "strides": [2, 1, 1, 1], "frame_stack": 3}
"""Of an encoder that is trained by the agent (DrQ-v2), unless chosen; they mean nothing beside one that is given."""


SHIFT = 4
"""Largest random shift in pixels, unless chosen (DrQ-v2, at 84 px)."""


@dataclass(frozen=True)
class OfflineOptions:
    """Described in :mod:`repdib_lightning.rl.finetune_offline`, which has the defaults. ``values`` holds what only
    TD3+BC takes: alpha, tau, noise, noise_clip."""

    agent: str
    data: Path
    encoder: Path | None
    env: str
    env_options: dict[str, Any] | None
    steps: int
    seed: int
    learning_rate: float
    batch_size: int
    hidden: int
    copies: int
    shift: int | None
    features: int | None
    channels: int | None
    strides: list[int] | None
    frame_stack: int | None
    evaluate_every: int
    episodes: int
    film: int
    device: str
    gamma: float = 0.99
    n_steps: int = 1
    values: Mapping[str, float] | None = None

    @property
    def pixels(self) -> int:
        """Largest random shift."""
        return SHIFT if self.shift is None else self.shift

    def fresh(self, name: str) -> Any:
        """An option of a fresh encoder."""
        chosen = getattr(self, name)
        return FRESH[name] if chosen is None else chosen


_COUNTS = ("steps", "batch_size", "hidden", "copies", "evaluate_every", "episodes", "n_steps")


def check_offline_options(options: OfflineOptions) -> None:
    """Raise UserError for a number out of range, or options that exclude each other."""
    for name in _COUNTS:
        if getattr(options, name) < 1:
            raise UserError(f"--{name} must be at least 1, is {getattr(options, name)}")
    for name, value in (("seed", options.seed), ("shift", options.pixels), ("film", options.film)):
        if not 0 <= value < 2**32:
            raise UserError(f"--{name} must be from 0 to {2**32 - 1}, is {value}")
    if not 0.0 < options.learning_rate < math.inf:
        raise UserError(f"--learning_rate must be above 0 and finite, is {options.learning_rate}")
    if not 0.0 <= options.gamma <= 1.0:
        raise UserError(f"--gamma must be in [0, 1], is {options.gamma}")
    values = options.values or {}
    for name in ("alpha", "noise", "noise_clip"):
        if not 0.0 <= values.get(name, 0.0) < math.inf:
            raise UserError(f"--{name} must be finite and not negative, is {values[name]}")
    if not 0.0 < values.get("tau", 1.0) <= 1.0:
        raise UserError(f"--tau must be above 0 and at most 1, is {values['tau']}")
    check_device_name(options.device)
    _check_encoder(options)


def _check_encoder(options: OfflineOptions) -> None:
    for name in FRESH:
        if options.encoder is not None and getattr(options, name) is not None:
            raise UserError(f"--{name} is of an encoder that the agent trains; leave it out beside --encoder")
        values = [options.fresh(name)] if name != "strides" else options.fresh(name)
        if min(values, default=0) < 1:
            raise UserError(f"--{name} must be at least 1, is {options.fresh(name)}")
    if options.encoder is not None and options.copies == 1 and options.shift is not None:
        raise UserError(
            "--shift means nothing beside --encoder with one copy of each frame; add --copies, or leave it out"
        )
    if options.encoder is None and options.copies > 1:
        raise UserError("--copies are of frames that a given encoder encodes once; leave it out without --encoder")
