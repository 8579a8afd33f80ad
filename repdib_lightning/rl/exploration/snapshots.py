"""Snapshots of an exploration: a bundle of the encoder, with the agent beside it."""

from __future__ import annotations

import copy
import json
import re
import shutil
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from safetensors import SafetensorError, safe_open
from safetensors.torch import save as as_bytes
from torch import Tensor

from repdib_lightning.bottlenecks.base import Bottleneck
from repdib_lightning.encoders.base import Encoder
from repdib_lightning.errors import UserError
from repdib_lightning.export.bundle import save_bundle, whole_folder
from repdib_lightning.export.description import CONFIG
from repdib_lightning.rl.exploration.ddpg import DDPG

FOLDER = "snapshots"
AGENT = "agent.safetensors"
_NAME = re.compile(r"frames-(\d+)")


@dataclass(frozen=True)
class AgentFile:
    """An agent as it was after some frames.

    Attributes:
        path: the file. facts: ``task``, ``frames``, ``action_repeat``, ``image_size``, ``hidden``, ... of its training.
        tensors: of a :class:`~repdib_lightning.rl.exploration.ddpg.DDPG`, by the names of its state.
    """

    path: Path
    facts: Mapping[str, Any]
    tensors: Mapping[str, Tensor]

    def part(self, prefix: str) -> dict[str, Tensor]:
        """The tensors of a part, such as ``actor.``, without the prefix."""
        return {name.removeprefix(prefix): t for name, t in self.tensors.items() if name.startswith(prefix)}


def snapshot_folder(run: Path, frames: int) -> Path:
    """Where the snapshot of a run after some frames lies; the names sort by frames."""
    return run / FOLDER / f"frames-{frames:09d}"


def snapshots_of(run: Path) -> dict[int, Path]:
    """Frames -> folder, in ascending order, of every snapshot of a run."""
    folders = (run / FOLDER).glob("frames-*") if (run / FOLDER).is_dir() else []
    found = {int(match[1]): folder for folder in folders if (match := _NAME.fullmatch(folder.name))}
    return dict(sorted(found.items()))


def find_snapshot(given: Path, frames: int | None = None) -> Path:
    """The bundle that is meant.

    Args:
        given: a run of exploration, the folder of a snapshot, a bundle, or any other run that was exported.
        frames: of the snapshot of a run; None for its newest one.

    Raises:
        UserError: no such snapshot (those there are listed), or ``frames`` of something that has none.
    """
    there = snapshots_of(given)
    if frames is not None:
        if frames in there:
            return there[frames]
        known = ", ".join(map(str, there)) if there else "none"
        raise UserError(f"--snapshot {frames}: not in {given}, which has {known}")
    if there:
        return there[max(there)]
    return given if (given / CONFIG).is_file() or not (given / "bundle").is_dir() else given / "bundle"


def write_snapshot(
    folder: Path,
    encoder: Encoder,
    bottleneck: Bottleneck,
    agent: DDPG,
    *,
    training: Mapping[str, Any],
    data: Mapping[str, Any],
    facts: Mapping[str, Any],
) -> Path:
    """Write encoder, bottleneck and agent into a folder that appears whole; an earlier snapshot there is replaced.

    Args:
        folder: see :func:`snapshot_folder`. training, data: of the bundle. facts: of the agent.

    Raises:
        UserError: as :func:`~repdib_lightning.export.bundle.save_bundle`.
    """
    tensors = {name: value.detach().float().cpu().contiguous() for name, value in agent.state_dict().items()}
    parts = copy.deepcopy(encoder).float().eval(), copy.deepcopy(bottleneck).float().eval()
    for left in folder.parent.glob(f".{folder.name}.*"):  # by a run that was killed here
        shutil.rmtree(left, ignore_errors=True)
    with whole_folder(folder) as aside:
        save_bundle(aside, *parts, training=training, data=data, overwrite=True)
        (aside / AGENT).write_bytes(as_bytes(tensors, {"agent": json.dumps(dict(facts))}))
    return folder


def read_agent(snapshot: Path) -> AgentFile | None:
    """The agent beside a bundle; None where there is none.

    Raises:
        UserError: a damaged file.
    """
    path = snapshot / AGENT
    if not path.is_file():
        return None
    try:
        with safe_open(path, framework="pt") as file:
            facts = json.loads((file.metadata() or {})["agent"])
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 (not a dictionary)
        return AgentFile(path, {**facts, "hidden": int(facts["hidden"])}, tensors)
    except (SafetensorError, OSError, KeyError, TypeError, ValueError) as error:
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise UserError(f"{path}: not the agent of a snapshot ({reason})") from error
