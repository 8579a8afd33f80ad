"""Checkpoints of a training, and what may differ when it goes on after one."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch

from repdib_lightning.callbacks import generators
from repdib_lightning.callbacks.checkpoint_files import FOLDER, last_good, listed, step_of, step_path, sweep_temporaries
from repdib_lightning.callbacks.checkpoint_io import AtomicCheckpointIO
from repdib_lightning.errors import UserError, nearest
from repdib_lightning.rl.decision_transformer.module import DecisionTransformerModule
from repdib_lightning.rl.options import CONFIGURATION

_FREE = ("data", "encoder", "device", "film")
"""Options that may differ: where things lie and run. The data are compared by their fingerprint."""


def save_checkpoint(
    folder: Path,
    number: int,
    module: DecisionTransformerModule,
    optimizer: torch.optim.Optimizer,
    *,
    rows: list[dict[str, float]],
    fingerprint: str,
    batches_per_epoch: int,
) -> None:
    """Write ``checkpoints/step-NUMBER.ckpt``: whole or not at all, tensors and primitives only.

    Those at the end of an epoch stay; one that a preemption left inside an epoch goes once there is a later one.

    Args:
        folder: of the run. number: batches so far. module, optimizer: after them. rows: of progress.csv so far.
        fingerprint: of the data. batches_per_epoch: of this training.

    Raises:
        UserError: it cannot be written.
    """
    state = {
        "number": number,
        "weights": module.state_dict(),
        "optimizer": optimizer.state_dict(),
        "read": module.read,
        "rate": module.rate,
        "sums": module.sums,
        "generators": generators.capture(module.device),
        "rows": rows,
        "fingerprint": fingerprint,
    }
    AtomicCheckpointIO().save_checkpoint(state, step_path(folder / FOLDER, number))
    for path in listed(folder / FOLDER):
        if step_of(path) < number and step_of(path) % batches_per_epoch:
            path.unlink(missing_ok=True)


def load_checkpoint(folder: Path, fingerprint: str) -> dict[str, Any] | None:
    """The newest checkpoint of a run that is whole; None where there is none yet.

    Raises:
        UserError: all are damaged, or the data are not those that the run was started on.
    """
    sweep_temporaries(folder / FOLDER)
    if not listed(folder / FOLDER):
        return None
    state = AtomicCheckpointIO().load_checkpoint(last_good(folder))
    if state["fingerprint"] != fingerprint:
        raise UserError(f"--resume {folder}: --data holds other data than the run was started on (fingerprint)")
    return state


def put_back(state: Mapping[str, Any], module: DecisionTransformerModule) -> None:
    """Give a module, wherever it is, the weights and counts of a checkpoint."""
    module.load_state_dict(state["weights"])
    module.read, module.rate, module.sums = state["read"], state["rate"], state["sums"]


def check_resumable(folder: Path, configuration: Mapping[str, Any]) -> None:
    """Check that a folder holds a run that these options began.

    Args:
        folder: of the run. configuration: as it is written into it.

    Raises:
        UserError: no such run, one of another agent, or an option that was another one.
    """
    path = folder / CONFIGURATION
    if not path.is_file():
        runs = [str(other.parent) for other in folder.parent.glob(f"*/{CONFIGURATION}")]
        raise UserError(f"--resume: {folder} is no run of finetune, {nearest(str(folder), runs) or 'there is none'}")
    try:
        before = json.loads(path.read_text())
        agent = before["agent"]
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise UserError(f"{path}: cannot be read ({type(error).__name__}: {error})") from error
    if agent != "dt":
        raise UserError(f"--resume: {folder} is a run of finetune {agent}, which begins anew with --overwrite")
    for name, value in configuration.items():
        if name not in _FREE and before.get(name) != value:
            raise UserError(
                f"--resume: --{name} was {before.get(name)} in {folder} and is {value} now; a run keeps its options, "
                "start a new one with another --run"
            )
    if (before.get("encoder") is None) != (configuration["encoder"] is None):
        raise UserError(f"--resume: {folder} was begun {'with' if before.get('encoder') else 'without'} --encoder")
