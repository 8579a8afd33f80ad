"""The options of the agents that learn a task of continuous control while they play it, checked."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, ClassVar, Self

from repdib_lightning.environments.urlb_tasks import URLB_TASKS
from repdib_lightning.errors import UserError, nearest
from repdib_lightning.rl.devices import check_device_name
from repdib_lightning.rl.offline_options import FRESH, SHIFT

ACTOR, BOTH, NEW = "actor", "both", "fresh"
STARTS = (ACTOR, BOTH, NEW)
"""What an agent begins with: a snapshot's actor, its actor and critic, or neither."""


HIDDEN = 1024
"""Width of the layers of a fresh agent, unless chosen (paper, table of continuous control)."""


@dataclass(frozen=True, kw_only=True)
class OnlineOptions:
    """Described in :mod:`repdib_lightning.rl.finetune_online`, which has the defaults; here are those of all agents."""

    algorithm: ClassVar[str]

    encoder: Path | None
    snapshot: int | None
    task: str
    env_options: dict[str, Any] | None
    frames: int
    seed: int
    frozen: bool | None
    bottleneck: bool
    bottleneck_losses: float | None
    learning_rate: float
    batch_size: int
    hidden: int | None
    gamma: float
    n_steps: int | None
    tau: float
    update_every: int
    seed_frames: int
    shift: int | None
    features: int | None
    channels: int | None
    strides: list[int] | None
    frame_stack: int | None
    evaluate_every: int
    episodes: int
    film: int
    value_limit: float
    device: str

    @classmethod
    def of(cls, given: Mapping[str, Any]) -> Self:
        """Pick these out of all arguments of the verb."""
        return cls(**{item.name: given[item.name] for item in fields(cls)})

    @property
    def is_frozen(self) -> bool:
        """Whether the encoder stays as it is; unless said, a given one does."""
        return self.encoder is not None if self.frozen is None else self.frozen

    @property
    def losses_weight(self) -> float:
        """Of the bottleneck's own losses."""
        return 1.0 if self.bottleneck_losses is None else self.bottleneck_losses

    @property
    def pixels(self) -> int:
        """Largest random shift."""
        return SHIFT if self.shift is None else self.shift

    @property
    def steps_of_returns(self) -> int:
        """n of the return that is bootstrapped from."""
        return 3 if self.n_steps is None else self.n_steps

    def fresh(self, name: str) -> Any:
        """An option of a fresh encoder."""
        chosen = getattr(self, name)
        return FRESH[name] if chosen is None else chosen


@dataclass(frozen=True, kw_only=True)
class DDPGOptions(OnlineOptions):
    """And what only DDPG takes."""

    algorithm: ClassVar[str] = "ddpg"

    agent: str | None
    noise: float
    noise_clip: float
    standardise: bool | None
    action_penalty: float


@dataclass(frozen=True, kw_only=True)
class SACOptions(OnlineOptions):
    """And what only SAC takes."""

    algorithm: ClassVar[str] = "sac"

    buffer_size: int

    @property
    def steps_of_returns(self) -> int:
        """n; Stable-Baselines3 keeps longer returns of latents only."""
        return super().steps_of_returns if self.is_frozen or self.n_steps is not None else 1


_COUNTS = ("frames", "batch_size", "hidden", "n_steps", "update_every", "evaluate_every", "episodes", "buffer_size")


def check_online_options(options: OnlineOptions) -> None:
    """Raise UserError for a number out of range, or options that exclude each other."""
    for name in _COUNTS:
        value = getattr(options, name, None)
        if value is not None and value < 1:
            raise UserError(f"--{name} must be at least 1, is {value}")
    named = ("seed", options.seed), ("shift", options.pixels), ("film", options.film), ("snapshot", options.snapshot)
    for name, value in (*named, ("seed_frames", options.seed_frames)):
        if value is not None and not 0 <= value < 2**32:
            raise UserError(f"--{name} must be from 0 to {2**32 - 1}, is {value}")
    for name in ("learning_rate", "value_limit"):
        if not 0.0 < getattr(options, name) < math.inf:
            raise UserError(f"--{name} must be above 0 and finite, is {getattr(options, name)}")
    for name in ("noise", "noise_clip", "action_penalty", "bottleneck_losses"):
        value = getattr(options, name, None)
        if value is not None and not 0.0 <= value < math.inf:
            raise UserError(f"--{name} must be finite and not negative, is {value}")
    if not 0.0 <= options.gamma <= 1.0:
        raise UserError(f"--gamma must be in [0, 1], is {options.gamma}")
    if not 0.0 < options.tau <= 1.0:
        raise UserError(f"--tau must be above 0 and at most 1, is {options.tau}")
    if options.seed_frames >= options.frames:
        raise UserError(f"--seed_frames {options.seed_frames}: must be below --frames {options.frames}")
    check_device_name(options.device)
    _check_encoder(options)
    if isinstance(options, DDPGOptions):
        _check_start(options)
    if isinstance(options, SACOptions) and options.steps_of_returns > 1 and not options.is_frozen:
        raise UserError(f"--n_steps {options.n_steps}: Stable-Baselines3 keeps longer returns with --frozen true only")


def _check_encoder(options: OnlineOptions) -> None:
    for name in FRESH:
        if options.encoder is not None and getattr(options, name) is not None:
            raise UserError(f"--{name}: is of a fresh encoder, --encoder {options.encoder} has its own; leave it out")
        values = [options.fresh(name)] if name != "strides" else options.fresh(name)
        if min(values, default=0) < 1:
            raise UserError(f"--{name} must be at least 1, is {options.fresh(name)}")
    if options.encoder is None:
        _check_from_scratch(options)
    elif options.is_frozen:
        for name in ("bottleneck_losses", "shift"):
            if getattr(options, name) is not None:
                raise UserError(f"--{name} is of an encoder that the agent trains; add --frozen false, or leave it out")
    if not options.bottleneck and options.bottleneck_losses is not None:
        raise UserError("--bottleneck_losses mean nothing with --bottleneck false; leave one of them out")


def _check_from_scratch(options: OnlineOptions) -> None:
    if options.snapshot is not None:
        raise UserError(f"--snapshot {options.snapshot}: is of a run of exploration; name it with --encoder")
    if options.frozen:
        raise UserError("--frozen needs --encoder: a fresh encoder that is never trained knows nothing")
    if not options.bottleneck or options.bottleneck_losses is not None:
        name = "bottleneck_losses" if options.bottleneck else "bottleneck"
        raise UserError(f"--{name}: a fresh encoder has no bottleneck; leave it out, or name an --encoder")
    if not options.task:
        raise UserError(f"--task: name one, choices: {', '.join(URLB_TASKS)}, or any other of the Control Suite")


def _check_start(options: DDPGOptions) -> None:
    if options.agent is None or options.agent == NEW:
        return
    if options.agent not in STARTS:
        raise UserError(f"--agent {options.agent}: unknown, {nearest(options.agent, STARTS)}")
    if options.encoder is None:
        raise UserError(f"--agent {options.agent}: is one that explored; name its run with --encoder")
    if not options.bottleneck:
        raise UserError(f"--agent {options.agent}: explored behind the bottleneck; --bottleneck false needs fresh")
