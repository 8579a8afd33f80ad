"""Keeps the weights of a policy from before an update that spoils it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import torch
from torch import Tensor, nn

from repdib_lightning.errors import UserError


class Spoiled(UserError):
    """A loss or a value that is no number, or has grown beyond all measure."""


class LastGood:
    """A copy of the weights and running codebooks of some modules.

    An update offers them before its step, and accepts the offer once what it computed from them was sound.

    Args:
        modules: whose.
    """

    def __init__(self, modules: Sequence[nn.Module]) -> None:
        self._modules = list(modules)
        self._kept, self._offered = self._copies(), self._copies()

    def _now(self) -> list[Tensor]:
        return [tensor for module in self._modules for tensor in module.state_dict().values()]

    def _copies(self) -> list[Tensor]:
        return [tensor.detach().clone() for tensor in self._now()]

    @torch.no_grad()
    def offer(self) -> None:
        """Copy the weights of now."""
        torch._foreach_copy_(self._offered, self._now())

    def accept(self) -> None:
        """The weights that were offered last are good."""
        self._kept, self._offered = self._offered, self._kept

    @torch.no_grad()
    def restore(self) -> None:
        """Give the modules the last good weights."""
        torch._foreach_copy_(self._now(), self._kept)


def check_sound(values: Mapping[str, float], limit: float) -> None:
    """Raise :class:`Spoiled` for a value that is not finite, or a mean value of actions beyond the limit.

    Args:
        values: name -> number, of one update. limit: of those that are values of actions: ``value`` and ``actor``.
    """
    for name, value in values.items():
        if not -float("inf") < value < float("inf"):
            raise Spoiled(f"train/{name} is {value}")
        if name in ("value", "actor") and abs(value) > limit:
            raise Spoiled(f"train/{name} is {value:.4g}, beyond --value_limit {limit:g}")


def told(spoiled: Spoiled, frames: int, policy: Path) -> UserError:
    """The error for the user.

    Args:
        spoiled: what was found. frames: when. policy: the file that holds the last good policy.
    """
    return UserError(
        f"{spoiled} after {frames} frames: the critic has diverged, try a smaller --learning_rate; {policy} holds the "
        "policy of before"
    )
