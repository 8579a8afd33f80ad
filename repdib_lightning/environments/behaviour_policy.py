"""Policies that see the state and act: what behaviour data of the Control Suite is recorded with."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save_file

from repdib_lightning.data.files import whole_file
from repdib_lightning.errors import UserError, nearest

FOLDER = Path(__file__).parent / "policies"
"""Policies that ship with the package: ``TASK.safetensors``."""

LOG_STD_BOUNDS = (-20.0, 2.0)
"""Of the Gaussian before tanh, as Stable-Baselines3's SAC has them."""


@dataclass(frozen=True)
class Network:
    """A Gaussian squashed by tanh: ReLU layers, then a mean and a log-standard-deviation (SAC, Haarnoja et al. 2018).

    Attributes:
        weights: of each layer, (out, in), the mean's and then the deviation's last. biases: (out,) each.
    """

    weights: tuple[np.ndarray, ...]
    biases: tuple[np.ndarray, ...]

    def act(self, state: np.ndarray, random: np.random.Generator | None) -> np.ndarray:
        """(X,) state to (A,) action in (-1, 1): drawn, or the mode without a generator."""
        hidden = state.astype(np.float32)
        for weight, bias in zip(self.weights[:-2], self.biases[:-2], strict=True):
            hidden = np.maximum(weight @ hidden + bias, 0.0)
        mean = self.weights[-2] @ hidden + self.biases[-2]
        if random is None:
            return np.tanh(mean)
        log_std = np.clip(self.weights[-1] @ hidden + self.biases[-1], *LOG_STD_BOUNDS)
        return np.tanh(mean + np.exp(log_std) * random.standard_normal(len(mean)).astype(np.float32))


@dataclass(frozen=True)
class PolicyFile:
    """Networks of one training run, from early to late.

    Attributes:
        path: where they were read. facts: the file's metadata: ``task``, ``action_repeat``, ``algorithm``, ``command``,
            and ``networks``, name -> ``steps`` and ``return``.
        networks: name -> network; ``medium``, ``expert`` and ``replay_0`` (untrained) to ``replay_N`` (medium).
    """

    path: Path
    facts: Mapping[str, Any]
    networks: Mapping[str, Network]

    @property
    def replay(self) -> list[str]:
        """Names of the networks on the way to ``medium``, in the order of training."""
        return sorted((name for name in self.networks if re.fullmatch(r"replay_\d+", name)), key=lambda n: int(n[7:]))

    def network(self, name: str) -> Network:
        """One of the networks. Raises UserError if it is not there."""
        if name not in self.networks:
            raise UserError(f"--policy {self.path}: has no network '{name}', {nearest(name, self.networks)}")
        return self.networks[name]


def packaged_policy(task: str) -> Path:
    """The file of a task's policies.

    Raises:
        UserError: none ships with the package.
    """
    path = FOLDER / f"{task}.safetensors"
    if not path.is_file():
        known = [file.stem for file in FOLDER.glob("*.safetensors")]
        raise UserError(
            f"no policies of {task} ship with the package, {nearest(task, known)}; train some: "
            f"python -m repdib_lightning collect policies {task}.safetensors --task {task}, then name them by --policy"
        )
    return path


def read_policies(path: Path, *, task: str, action_repeat: int, state: int, actions: int) -> PolicyFile:
    """Read policies and check that they are of this task.

    Args:
        path: the file. task, action_repeat: what they are to play. state, actions: widths X and A of that task.

    Raises:
        UserError: no such file, not policies, or of another task, action repeat or size.
    """
    if not path.is_file():
        raise UserError(f"--policy {path}: no such file")
    try:
        with safe_open(path, framework="numpy") as file:
            facts = json.loads((file.metadata() or {})["policies"])
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 (not a dictionary)
        networks = {name: _network(tensors, name) for name in facts["networks"]}
    except (SafetensorError, OSError, KeyError, TypeError, ValueError) as error:
        raise UserError(
            f"--policy {path}: not policies of 'collect policies' ({type(error).__name__}: {error})"
        ) from error
    if facts.get("task") != task:
        raise UserError(f"--policy {path}: plays {facts.get('task')}, the task is {task}")
    if facts.get("action_repeat") != action_repeat:
        raise UserError(
            f"--policy {path}: was trained with action_repeat {facts.get('action_repeat')}, this recording has "
            f"{action_repeat}"
        )
    for name, network in networks.items():
        sizes = (network.weights[0].shape[1], network.weights[-1].shape[0])
        if sizes != (state, actions):
            raise UserError(
                f"--policy {path}: '{name}' maps {sizes[0]} to {sizes[1]}, {task} needs {state} to {actions}"
            )
    return PolicyFile(path, facts, networks)


def write_policies(path: Path, facts: Mapping[str, Any], networks: Mapping[str, Network]) -> None:
    """Write policies, whole. Raises UserError if the file cannot be written."""
    tensors = {
        f"{name}/{layer}/{part}": np.ascontiguousarray(value, np.float32)
        for name, network in networks.items()
        for part, values in (("weight", network.weights), ("bias", network.biases))
        for layer, value in enumerate(values)
    }
    with whole_file(path) as aside:
        save_file(tensors, aside, metadata={"policies": json.dumps(dict(facts))})


def _network(tensors: Mapping[str, np.ndarray], name: str) -> Network:
    layers = range(sum(key.startswith(f"{name}/") for key in tensors) // 2)
    if len(layers) < 3:
        raise ValueError(f"'{name}' has {len(layers)} layers, at least 3 are needed")
    weights = tuple(tensors[f"{name}/{layer}/weight"] for layer in layers)
    biases = tuple(tensors[f"{name}/{layer}/bias"] for layer in layers)
    sources = [*weights[:-2], weights[-3]]  # the mean and the deviation are computed from the same hidden layer
    fits = all(w.ndim == 2 and b.shape == w.shape[:1] for w, b in zip(weights, biases, strict=True))
    if not (fits and all(w.shape[1] == s.shape[0] for w, s in zip(weights[1:], sources, strict=True))):
        raise ValueError(f"the layers of '{name}' do not fit each other")
    if not (weights[-1].shape == weights[-2].shape and all(np.isfinite(v).all() for v in (*weights, *biases))):
        raise ValueError(f"'{name}' holds values that are not finite, or as many means as deviations")
    return Network(weights, biases)
