"""The options of ``finetune dqn``, checked."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from repdib_lightning.errors import UserError
from repdib_lightning.rl import FRESH_OPTIONS

CONFIGURATION, PROGRESS, OUTCOME = "finetune.json", "progress.csv", "outcome.json"
FILM = "evaluation.mp4"
"""What an offline agent films."""


@dataclass(frozen=True)
class DQNOptions:
    """Described in :func:`repdib_lightning.rl.finetune_dqn.finetune_dqn`, which has the defaults."""

    env: str
    encoder: Path | None
    frozen: bool
    steps: int
    seed: int
    env_options: dict[str, Any] | None
    bottleneck_losses: float
    learning_rate: float
    batch_size: int
    gamma: float
    tau: float
    hidden: int
    buffer_size: int
    learning_starts: int
    train_freq: int
    n_steps: int
    exploration_fraction: float
    exploration_final_eps: float
    features: int | None
    channels: int | None
    strides: list[int] | None
    evaluate_every: int
    device: str

    @classmethod
    def of(cls, given: Mapping[str, Any]) -> DQNOptions:
        """Pick these out of all arguments of the verb."""
        return cls(**{name: given[name] for name in cls.__dataclass_fields__})


FRESH = tuple(name for name in FRESH_OPTIONS if name in DQNOptions.__dataclass_fields__)
"""Options of a fresh encoder."""

_COUNTS = ("steps", "batch_size", "hidden", "buffer_size", "train_freq", "n_steps", "evaluate_every")
_SHARES = ("gamma", "tau", "exploration_fraction", "exploration_final_eps")


def check_options(options: DQNOptions) -> None:
    """Raise UserError for a number out of range, or options that exclude each other."""
    for name in _COUNTS:
        if getattr(options, name) < 1:
            raise UserError(f"--{name} must be at least 1, is {getattr(options, name)}")
    for name in _SHARES:
        if not 0.0 <= getattr(options, name) <= 1.0:
            raise UserError(f"--{name} must be in [0, 1], is {getattr(options, name)}")
    if not options.learning_rate > 0.0:
        raise UserError(f"--learning_rate must be above 0, is {options.learning_rate}")
    if options.exploration_fraction == 0.0 or options.tau == 0.0:
        zero = "exploration_fraction" if options.exploration_fraction == 0.0 else "tau"
        raise UserError(f"--{zero} must be above 0")
    for name in ("seed", "learning_starts", "bottleneck_losses"):
        if not getattr(options, name) >= 0:
            raise UserError(f"--{name} must not be negative, is {getattr(options, name)}")
    if options.learning_starts >= options.steps:
        raise UserError(f"--learning_starts {options.learning_starts}: must be below --steps {options.steps}")
    if options.buffer_size < options.batch_size:
        raise UserError(f"--buffer_size {options.buffer_size}: must hold a batch, --batch_size is {options.batch_size}")
    if options.seed >= 2**32:
        raise UserError(f"--seed must be below {2**32}, is {options.seed}")
    if options.n_steps > 1 and not options.frozen:
        raise UserError(f"--n_steps {options.n_steps}: Stable-Baselines3 keeps longer returns with --frozen only")
    if options.frozen and options.encoder is None:
        raise UserError("--frozen needs --encoder BUNDLE: a fresh encoder that is never trained knows nothing")
    for name in FRESH:
        if options.encoder is not None and getattr(options, name) is not None:
            raise UserError(f"--{name}: is of a fresh encoder, --encoder {options.encoder} has its own; leave it out")


def plain(options: Mapping[str, Any]) -> dict[str, Any]:
    """Options as JSON can hold them."""
    return {name: str(value) if isinstance(value, Path) else value for name, value in options.items()}
