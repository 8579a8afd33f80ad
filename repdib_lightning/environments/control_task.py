"""One task of the DeepMind Control Suite, stepped at an action repeat: physics and rewards, no pictures."""

from __future__ import annotations

import logging
import math
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np

from repdib_lightning.environments.rendering import no_renderer, prepare_rendering
from repdib_lightning.errors import UserError, nearest

SEPARATOR = "-"
_CAMERAS = {"quadruped": 2}
"""Domains that are filmed by another camera than the first (as in DrQ-v2, V-D4RL and URLB)."""


class ControlTask:
    """A task such as ``walker-walk`` (Tassa et al. 2018, "DeepMind Control Suite").

    Args:
        name: domain and task. ``walker_walk``, as V-D4RL writes it, is understood too.
        action_repeat: physics steps (of the task's control interval) an action is held for; rewards are summed, so that
            a return stays on the scale of 0 to 1000 whatever the repeat.

    Attributes:
        name: ``domain-task``. camera: number of the camera that films it.
        actions: A; each dimension in [-1, 1], scaled to the task's own bounds.
        sizes: name -> width of what the task observes of its state (positions, velocities, touch, ...).
        steps: actions until an episode is truncated.

    Raises:
        UserError: an unknown task, one that never ends (``lqr``), an action repeat below 1, MuJoCo 4, or no OpenGL
            backend to import.
    """

    def __init__(self, name: str, action_repeat: int = 2) -> None:
        if action_repeat < 1:
            raise UserError(f"action_repeat={action_repeat}: must be at least 1")
        self.action_repeat = action_repeat
        suite = load_suite()
        domain, task = _find(name, suite.ALL_TASKS)
        self.name, self.camera = SEPARATOR.join((domain, task)), _CAMERAS.get(domain, 0)
        with _without_deprecations():
            self._environment = suite.load(domain, task, task_kwargs={"random": 0})
        bounds = self._environment.action_spec()
        self._low, self._high = bounds.minimum.astype(np.float64), bounds.maximum.astype(np.float64)
        self.actions = len(self._low)
        limit = self._environment._step_limit
        if not np.isfinite(limit):
            raise UserError(f"task {self.name}: its episodes never end and its actions have no bounds; choose another")
        self.steps = math.ceil(limit / action_repeat)
        self._seen = self._environment.reset().observation
        self.sizes = {key: int(np.size(value)) for key, value in self._seen.items()}

    @property
    def model(self) -> Any:
        """MuJoCo's model (``MjModel``)."""
        return self._environment.physics.model.ptr

    @property
    def data(self) -> Any:
        """MuJoCo's state of the moment (``MjData``)."""
        return self._environment.physics.data.ptr

    def reset(self, random: np.random.Generator) -> None:
        """Begin an episode from a start that only the generator decides."""
        self._environment.task.random.seed(int(random.integers(2**32)))
        self._seen = self._environment.reset().observation

    def step(self, action: np.ndarray) -> tuple[float, bool, bool]:
        """Hold an action (A,) in [-1, 1]; values outside are clipped.

        Returns:
            reward, summed over the repeats; whether the episode has terminated; whether it is truncated.
        """
        share = (np.clip(np.asarray(action, np.float64), -1.0, 1.0) + 1.0) / 2.0
        scaled = self._low + share * (self._high - self._low)
        reward = 0.0
        for _ in range(self.action_repeat):
            moment = self._environment.step(scaled)
            reward += float(moment.reward or 0.0)
            if moment.last():
                break
        self._seen = moment.observation
        terminated = bool(moment.last() and moment.discount == 0.0)
        return reward, terminated, moment.last() and not terminated

    def factors(self) -> dict[str, np.ndarray]:
        """Name -> (width,) float32: what the task observes of its state."""
        return {key: np.atleast_1d(np.asarray(value, np.float32)).reshape(-1) for key, value in self._seen.items()}

    def state(self) -> np.ndarray:
        """(X,) float32: the factors in one vector, as state-based policies take them."""
        return np.concatenate(list(self.factors().values()))


@contextmanager
def _without_deprecations() -> Iterator[None]:
    """Keep back what MuJoCo says of attributes in the suite's own files, which a user cannot change."""
    log = logging.getLogger("absl")
    log.addFilter(_is_of_use)
    try:
        yield
    finally:
        log.removeFilter(_is_of_use)


def _is_of_use(record: logging.LogRecord) -> bool:
    return "is deprecated and will be removed" not in record.getMessage()


def load_suite() -> Any:
    """Import ``dm_control.suite``, once MuJoCo is known to be of a version that it works with.

    Raises:
        UserError: MuJoCo 4, or no OpenGL backend that can be used.
    """
    prepare_rendering()
    try:
        from dm_control import suite
    except (ImportError, AttributeError, RuntimeError, OSError) as error:  # it opens the renderer, too
        raise no_renderer(error) from error
    return suite


def _find(name: str, known: tuple[tuple[str, str], ...]) -> tuple[str, str]:
    for domain, task in known:
        if name in (f"{domain}{SEPARATOR}{task}", f"{domain}_{task}"):
            return domain, task
    domain = name.partition(SEPARATOR)[0]
    domains = sorted({first for first, _ in known})
    if SEPARATOR in name and domain not in domains:
        raise UserError(f"task {name}: unknown domain '{domain}', {nearest(domain, domains)}")
    of_domain = [SEPARATOR.join(pair) for pair in known if pair[0] == domain]
    raise UserError(f"task {name}: unknown, {nearest(name, of_domain or [SEPARATOR.join(pair) for pair in known])}")
