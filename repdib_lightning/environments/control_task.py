"""One task of the DeepMind Control Suite or of URLB, stepped at an action repeat: physics and rewards, no pictures."""

from __future__ import annotations

import logging
import math
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np

from repdib_lightning.environments.rendering import no_renderer, prepare_rendering
from repdib_lightning.environments.urlb_tasks import SEPARATOR, URLB_TASKS, Loaded, load_urlb
from repdib_lightning.errors import UserError, nearest

_CAMERAS = {"quadruped": 2}
"""Domains that are filmed by another camera than the first (as in DrQ-v2, V-D4RL and URLB)."""


class ControlTask:
    """A task such as ``walker-walk`` (Tassa et al. 2018, "DeepMind Control Suite") or one of URLB's twelve.

    Args:
        name: domain and task. ``walker_walk``, as V-D4RL and URLB write it, is understood too.
        action_repeat: physics steps (of the task's control interval) an action is held for; rewards are summed, so that
            a return stays on the scale of 0 to 1000 (``jaco``: 250) whatever the repeat.

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
        domain, task = _find(name, _known(suite))
        self.name, self.camera = SEPARATOR.join((domain, task)), _CAMERAS.get(domain, 0)
        with _without_noise():
            loaded = _load(suite, domain, task)
        self._environment, self._random = loaded.environment, loaded.random
        bounds = self._environment.action_spec()
        self._low, self._high = bounds.minimum.astype(np.float64), bounds.maximum.astype(np.float64)
        self.actions = len(self._low)
        if not np.isfinite(loaded.limit):
            raise UserError(f"task {self.name}: its episodes never end and its actions have no bounds; choose another")
        self.steps = math.ceil(loaded.limit / action_repeat)
        self._seen = self._environment.reset().observation
        self.sizes = {key: value.size for key, value in self.factors().items()}

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
        self._random.seed(int(random.integers(2**32)))
        with _without_noise():
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
        return {_short(key): np.asarray(value, np.float32).reshape(-1) for key, value in self._seen.items()}

    def state(self) -> np.ndarray:
        """(X,) float32: the factors in one vector, as state-based policies take them."""
        return np.concatenate(list(self.factors().values()))


@contextmanager
def _without_noise() -> Iterator[None]:
    """Keep back what no user can change: deprecated attributes in the suite's own files, and starts of an arm that its
    inverse kinematics does not find and that are then drawn anew."""
    log = logging.getLogger("absl")
    log.addFilter(_is_of_use)
    try:
        yield
    finally:
        log.removeFilter(_is_of_use)


def _is_of_use(record: logging.LogRecord) -> bool:
    said = record.getMessage()
    return "is deprecated and will be removed" not in said and not said.startswith("Failed to converge after")


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


def _known(suite: Any) -> tuple[tuple[str, str], ...]:
    """(domain, task) of the suite's own tasks, then of those that only URLB has."""
    urlb = [(domain, task) for domain, _, task in (name.partition(SEPARATOR) for name in URLB_TASKS)]
    return (*suite.ALL_TASKS, *(pair for pair in urlb if pair not in suite.ALL_TASKS))


def _load(suite: Any, domain: str, task: str) -> Loaded:
    if (domain, task) in suite.ALL_TASKS:
        return Loaded.of_suite(suite.load(domain, task, task_kwargs={"random": 0}))
    return load_urlb(domain, task)


def _short(key: str) -> str:
    """``jaco_hand_joints_pos`` for composer's ``jaco_arm/jaco_hand/joints_pos``: a store's names hold no slash."""
    return "_".join(key.split("/")[-2:])


def _find(name: str, known: tuple[tuple[str, str], ...]) -> tuple[str, str]:
    for domain, task in known:
        if name in (f"{domain}{SEPARATOR}{task}", f"{domain}_{task}"):
            return domain, task
    domain, urlb = name.partition(SEPARATOR)[0], f"; URLB's: {', '.join(URLB_TASKS)}"
    domains = sorted({first for first, _ in known})
    if SEPARATOR in name and domain not in domains:
        raise UserError(f"task {name}: unknown domain '{domain}', {nearest(domain, domains)}{urlb}")
    of_domain = [SEPARATOR.join(pair) for pair in known if pair[0] == domain]
    near = nearest(name, of_domain or [SEPARATOR.join(pair) for pair in known])
    raise UserError(f"task {name}: unknown, {near}{urlb}")
