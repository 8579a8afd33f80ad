"""The options of ``finetune dt``, checked."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from repdib_lightning.errors import UserError
from repdib_lightning.rl.devices import check_device_name

FRESH: dict[str, Any] = {"channels": [32, 64, 64], "kernels": [8, 4, 3], "strides": [4, 2, 1], "frame_stack": 4}
"""Of an encoder that is trained end to end, unless chosen: the published one."""

TARGETS = {"breakout": 90.0, "seaquest": 1150.0, "qbert": 14_000.0, "pong": 20.0}
"""Game -> return that the published program asks for."""


@dataclass(frozen=True)
class DTOptions:
    """Described in :func:`repdib_lightning.rl.finetune_dt.finetune_dt`, which has the defaults."""

    data: Path
    encoder: Path | None
    codes: bool
    env: str
    env_options: dict[str, Any] | None
    target_return: float | None
    temperature: float
    epochs: int
    steps_per_epoch: int | None
    stride: int
    context: int
    layers: int
    heads: int
    width: int
    dropout: float
    learning_rate: float
    weight_decay: float
    batch_size: int
    warmup_tokens: int
    channels: list[int] | None
    kernels: list[int] | None
    strides: list[int] | None
    frame_stack: int | None
    episodes: int
    evaluate_every: int
    film: int
    seed: int
    device: str

    @classmethod
    def of(cls, given: Mapping[str, Any]) -> DTOptions:
        """Pick these out of all arguments of the verb."""
        return cls(**{name: given[name] for name in cls.__dataclass_fields__})

    def fresh(self, name: str) -> Any:
        """An option of a fresh encoder."""
        chosen = getattr(self, name)
        return FRESH[name] if chosen is None else chosen


_COUNTS = (
    "epochs",
    "stride",
    "context",
    "layers",
    "heads",
    "width",
    "batch_size",
    "episodes",
    "evaluate_every",
)


def check_dt_options(options: DTOptions) -> None:
    """Raise UserError for a number out of range, or options that exclude each other."""
    for name in _COUNTS:
        if getattr(options, name) < 1:
            raise UserError(f"--{name} must be at least 1, is {getattr(options, name)}")
    if options.steps_per_epoch is not None and options.steps_per_epoch < 1:
        raise UserError(f"--steps_per_epoch must be at least 1, is {options.steps_per_epoch}")
    for name in ("seed", "film", "warmup_tokens"):
        if not 0 <= getattr(options, name) < 2**32:
            raise UserError(f"--{name} must be from 0 to {2**32 - 1}, is {getattr(options, name)}")
    for name in ("weight_decay", "temperature"):
        if not 0.0 <= getattr(options, name) < math.inf:
            raise UserError(f"--{name} must be finite and not negative, is {getattr(options, name)}")
    if not 0.0 < options.learning_rate < math.inf:
        raise UserError(f"--learning_rate must be above 0 and finite, is {options.learning_rate}")
    if not 0.0 <= options.dropout < 1.0:
        raise UserError(f"--dropout must be at least 0 and below 1, is {options.dropout}")
    if options.target_return is not None and not math.isfinite(options.target_return):
        raise UserError(f"--target_return must be a finite number, is {options.target_return}")
    if options.width % options.heads:
        raise UserError(f"--heads {options.heads}: must divide --width {options.width}")
    if options.stride > options.context:
        raise UserError(
            f"--stride {options.stride}: windows of --context {options.context} would leave steps of the data out; "
            f"choose at most {options.context}"
        )
    check_device_name(options.device)
    _check_encoder(options)


def _check_encoder(options: DTOptions) -> None:
    if options.codes and options.encoder is None:
        raise UserError("--codes are those of an encoder that is given; add --encoder, or leave it out")
    for name in FRESH:
        if options.encoder is not None and getattr(options, name) is not None:
            raise UserError(f"--{name} is of an encoder that is trained end to end; leave it out beside --encoder")
        values = [options.fresh(name)] if name == "frame_stack" else options.fresh(name)
        if min(values, default=0) < 1:
            raise UserError(f"--{name} must be at least 1, is {options.fresh(name)}")
    sizes = {name: len(options.fresh(name)) for name in ("channels", "kernels", "strides")}
    if len(set(sizes.values())) > 1:
        shown = ", ".join(f"--{name} {count}" for name, count in sizes.items())
        raise UserError(f"one number for each convolution is needed in each of these: {shown} are given")
