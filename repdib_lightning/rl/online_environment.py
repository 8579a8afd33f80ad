"""The task that an agent learns by playing: by default shown as its encoder has seen it in pre-training."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import gymnasium

from repdib_lightning.environments.control_env import ControlEnv
from repdib_lightning.errors import UserError
from repdib_lightning.records import DataSpec
from repdib_lightning.rl.environment import open_environment
from repdib_lightning.rl.offline_environment import CONTROL

_TAKEN = ("action_repeat", "image_size", "quality", "distractors", "place", "source", "distractor_seed")
"""Of a snapshot's training, unless chosen."""

_NOT_OURS = {
    "task": "name it with --task",
    "evaluation": "an agent learns amid some clips and is evaluated amid the others",
    "frame_stack": "frames are stacked as the encoder takes them; without --encoder, name it with --frame_stack",
}


def chosen_options(
    task: str, options: Mapping[str, Any], facts: Mapping[str, Any], spec: DataSpec | None
) -> dict[str, Any]:
    """Options of :class:`ControlEnv`, but for ``evaluation``.

    Args:
        task: empty for the one of ``facts``. options: what the user chose of the environment.
        facts: of a snapshot's training; empty without one. spec: of a given encoder.

    Raises:
        UserError: no task, or an option that is not for the user to choose.
    """
    for name, reason in _NOT_OURS.items():
        if name in options:
            raise UserError(f"--env_options.{name}: {reason}")
    if not task and "task" not in facts:
        raise UserError("--task: name one, such as walker-run; the encoder does not tell in which task it explored")
    taken = {name: facts[name] for name in _TAKEN if name in facts}
    pictures = [] if spec is None else [array.shape for array in spec.observations.values() if array.is_image]
    if pictures:
        taken["image_size"] = pictures[0][1]
    chosen = {"task": task or str(facts["task"]), **taken, **options}
    if chosen.get("distractors", "none") == "none":  # what was taken over of them means nothing then
        chosen = {name: value for name, value in chosen.items() if name in options or name not in ("place", "source")}
    return chosen


def open_task(chosen: Mapping[str, Any], *, evaluation: bool) -> gymnasium.Env[Any, Any]:
    """Open a task. Raises UserError where it cannot be."""
    try:
        return open_environment(CONTROL, {**chosen, "evaluation": evaluation})
    except UserError as error:
        told = str(error).removeprefix(f"--env {CONTROL}: ").replace(f"no option of {CONTROL}", "no such option")
        where = "" if told.startswith("--") else "--" if told.startswith("task ") else "--env_options: "
        raise UserError(f"{where}{told}") from error


def control_of(environment: gymnasium.Env[Any, Any]) -> ControlEnv:
    """The task inside all wrappers."""
    inner = environment.unwrapped
    assert isinstance(inner, ControlEnv)
    return inner
