"""Stops a run whose loss is no longer a number, before the broken weights are saved."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import lightning.pytorch as pl
import torch
from lightning.pytorch.callbacks import Callback
from torch import Tensor

from repdib_lightning.callbacks.checkpointing import RunCheckpoint
from repdib_lightning.errors import UserError


class StopOnNonFinite(Callback):
    """Raises a UserError that names the step, the loss terms that were not finite, and the last good checkpoint.

    The losses of the last steps are kept where they are and looked at together, so that the processor waits for the
    GPU once in ``every_n_steps``. Before any checkpoint is written they are looked at too, as are the parameters: a
    finite loss can still have had gradients that were not.

    Args:
        every_n_steps: batches between two looks.
    """

    def __init__(self, every_n_steps: int = 50) -> None:
        if every_n_steps < 1:
            raise UserError(f"non-finite check: every_n_steps must be at least 1, is {every_n_steps}")
        self.every_n_steps = every_n_steps
        self._kept: list[tuple[int, dict[str, Tensor]]] = []

    def on_train_batch_end(
        self, trainer: pl.Trainer, pl_module: pl.LightningModule, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        """Keep this batch's ``loss`` and ``terms``, and look at them when it is time."""
        self._kept.append((trainer.global_step, _scalars(outputs)))
        if len(self._kept) >= self.every_n_steps:
            self._check_losses(trainer)

    def on_train_end(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Look at the last losses."""
        self._check_losses(trainer)

    def on_save_checkpoint(
        self, trainer: pl.Trainer, pl_module: pl.LightningModule, checkpoint: dict[str, Any]
    ) -> None:
        """Refuse to save a broken state, whoever asks."""
        self._check_losses(trainer)
        broken = _broken_parameters(pl_module)
        if trainer.strategy.reduce_boolean_decision(bool(broken), all=False):
            name = broken[0] if broken else "one of another process"
            raise UserError(f"after step {trainer.global_step} parameter {name} is not finite; {_way_back(trainer)}")

    def _check_losses(self, trainer: pl.Trainer) -> None:
        found = _first_broken(self._kept)
        self._kept = []
        if trainer.strategy.reduce_boolean_decision(found is not None, all=False):
            where = f"step {found[0]}: {found[1]}" if found else f"by step {trainer.global_step}: of another process"
            raise UserError(f"the loss is not finite at {where}; {_way_back(trainer)}")


def _scalars(outputs: Any) -> dict[str, Tensor]:
    """``loss`` and the named terms of a training step's output."""
    if isinstance(outputs, Tensor):
        return {"loss": outputs.detach()}
    if not isinstance(outputs, Mapping) or not isinstance(outputs.get("loss"), Tensor):
        return {}
    return {**outputs.get("terms", {}), "loss": outputs["loss"].detach()}


def _first_broken(kept: list[tuple[int, dict[str, Tensor]]]) -> tuple[int, str] | None:
    """Step, and terms with their values, of the first batch that was not finite; the only wait for the device."""
    flat = [(step, name, value) for step, terms in kept for name, value in terms.items()]
    if not flat:
        return None
    values = torch.stack([value.detach().float() for _, _, value in flat]).cpu()
    broken = [
        (step, name, float(value)) for (step, name, _), value in zip(flat, values, strict=True) if not value.isfinite()
    ]
    if not broken:
        return None
    first = broken[0][0]
    return first, ", ".join(f"{name} is {value}" for step, name, value in broken if step == first)


def _broken_parameters(module: pl.LightningModule) -> list[str]:
    named = [(name, parameter) for name, parameter in module.named_parameters() if parameter.is_floating_point()]
    if not named:
        return []
    finite = torch.stack([parameter.detach().isfinite().all() for _, parameter in named]).tolist()
    return [name for (name, _), good in zip(named, finite, strict=True) if not good]


def _way_back(trainer: pl.Trainer) -> str:
    callbacks: list[Any] = trainer.callbacks  # type: ignore[attr-defined]
    paths = [callback.newest for callback in callbacks if isinstance(callback, RunCheckpoint)]
    newest = paths[0] if paths else None
    return f"the last good checkpoint is {newest}" if newest else "there is no checkpoint yet"
