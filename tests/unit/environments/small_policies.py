"""Files of small random policies, each of which plays differently and nearly without chance."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from repdib_lightning.environments.behaviour_policy import Network, write_policies

STATE, ACTIONS = 24, 6
"""Of the walker."""

NAMES = ("medium", "expert", *(f"replay_{age}" for age in range(4)))


def random_network(seed: int, state: int = STATE, actions: int = ACTIONS, hidden: int = 8) -> Network:
    """Two hidden layers; the standard deviation is exp(-20) whatever the state."""
    random = np.random.default_rng(seed)
    shapes = [(hidden, state), (hidden, hidden), (actions, hidden), (actions, hidden)]
    weights = [random.normal(0, 0.5, shape).astype(np.float32) for shape in shapes]
    biases = [random.normal(0, 0.5, rows).astype(np.float32) for rows, _ in shapes]
    weights[-1][:], biases[-1][:] = 0.0, -20.0
    return Network(tuple(weights), tuple(biases))


def write_small(path: Path, *, seed: int = 0, names: tuple[str, ...] = NAMES, **changed: Any) -> Path:
    """Policies of walker-walk at action repeat 50; ``changed`` facts, or sizes ``state`` and ``actions``."""
    sizes = {key: changed.pop(key) for key in ("state", "actions") if key in changed}
    networks = {name: random_network(10 * seed + i, **sizes) for i, name in enumerate(names)}
    told = {name: {"steps": 1, "return": 2.0} for name in names}
    facts = {"task": "walker-walk", "action_repeat": 50, "networks": told}
    write_policies(path, facts | changed, networks)
    return path
