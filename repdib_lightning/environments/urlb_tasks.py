"""The twelve tasks of the Unsupervised Reinforcement Learning Benchmark, by name."""

from __future__ import annotations

from dataclasses import dataclass
from importlib import import_module
from typing import Any

import numpy as np

from repdib_lightning.errors import UserError, nearest

SEPARATOR = "-"

URLB_TASKS = (
    "walker-stand",
    "walker-walk",
    "walker-run",
    "walker-flip",
    "quadruped-stand",
    "quadruped-walk",
    "quadruped-run",
    "quadruped-jump",
    "jaco-reach_top_left",
    "jaco-reach_top_right",
    "jaco-reach_bottom_left",
    "jaco-reach_bottom_right",
)
"""``domain-task`` of URLB (Laskin et al. 2021): an agent explores a domain and is fine-tuned to each of its tasks."""

_MODULES = {
    "walker": "repdib_lightning.environments.urlb_walker",
    "quadruped": "repdib_lightning.environments.urlb_quadruped",
    "jaco": "repdib_lightning.environments.urlb_jaco",
}


@dataclass(frozen=True)
class Loaded:
    """An environment of dm_control.

    Attributes:
        environment: the Control Suite's class or composer's.
        random: what the starts of its episodes are drawn from.
        limit: control steps of an episode.
    """

    environment: Any
    random: np.random.RandomState
    limit: float

    @classmethod
    def of_suite(cls, environment: Any) -> Loaded:
        """One of the Control Suite's class."""
        return cls(environment, environment.task.random, environment._step_limit)


def domain_of(task: str) -> str:
    """``walker`` of ``walker-flip``, or of ``walker_flip``.

    Raises:
        UserError: neither one of URLB's tasks nor ``domain-task``.
    """
    urlb = {name.replace(SEPARATOR, "_", 1): name for name in URLB_TASKS}
    domain, separator, _ = urlb.get(task, task).partition(SEPARATOR)
    if not separator:
        raise UserError(f"task {task}: not a task of URLB nor domain{SEPARATOR}task, {nearest(task, URLB_TASKS)}")
    return domain


def load_urlb(domain: str, task: str) -> Loaded:
    """Load a task of URLB that the Control Suite lacks; ``control_task.load_suite`` has to be called before."""
    return import_module(_MODULES[domain]).load(task)


def gymnasium_name(task: str) -> str:
    """``WalkerRun`` for ``walker-run``."""
    return "".join(part.capitalize() for part in task.replace(SEPARATOR, "_").split("_"))
