"""What may change when a run goes on, and what may not."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import yaml

from repdib_lightning.callbacks import read_status
from repdib_lightning.errors import UserError

_FIXED = ("seed_everything", "model", "data")
_FREE = tuple(f"data.init_args.{name}" for name in ("path", "workers", "resident", "processes"))


def check_idle(folder: Path) -> None:
    """Raise UserError if a living process is training this run."""
    status = read_status(folder)
    if status is not None and status.state == "running":
        raise UserError(
            f"{folder}: process {status.process} on {status.host} is training this run; wait for it, or stop it first"
        )


def check_unchanged(folder: Path, saved: str, now: str) -> None:
    """Raise UserError if the model, the data or the seed differ from what the run was started with.

    Args:
        folder: of the run.
        saved: its config.yaml.
        now: the configuration it is to go on with, as YAML.
    """
    before, after = dict(_leaves(yaml.safe_load(saved))), dict(_leaves(yaml.safe_load(now)))
    for key in sorted(before.keys() | after.keys()):
        fixed = key.split(".")[0] in _FIXED and key not in _FREE
        if fixed and before.get(key) != after.get(key):
            raise UserError(
                f"--resume {folder}: {key} was {before.get(key)} and is {after.get(key)} now; "
                "a run keeps its model, data and seed: start a new one with --run"
            )


def check_same_data(folder: Path, data: Mapping[str, Any]) -> None:
    """Raise UserError if the data, of which file and fingerprint are told, are not what the run was started on."""
    facts = folder / "environment.json"
    if not facts.is_file():
        return
    started_on = json.loads(facts.read_text())["data"]["fingerprint"]
    if started_on and started_on != data["fingerprint"]:
        raise UserError(f"--resume {folder}: {data['file']} holds other data than the run was started on (fingerprint)")


def _leaves(tree: Any, prefix: str = "") -> Iterator[tuple[str, Any]]:
    if isinstance(tree, dict) and tree:
        for key, value in tree.items():
            yield from _leaves(value, f"{prefix}.{key}" if prefix else str(key))
    else:
        yield prefix, None if tree == {} else tree  # a class without options: {} once saved, absent when parsed again
