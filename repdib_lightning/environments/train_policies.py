"""Trains the policies that behaviour data are recorded with: ``collect policies``."""

from __future__ import annotations

import math
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

from repdib_lightning.data.outputs import check_output_file
from repdib_lightning.environments.behaviour_policy import Network, write_policies
from repdib_lightning.environments.control_state_env import ControlStateEnv
from repdib_lightning.errors import UserError

REPLAYED = 8
"""Networks that are kept of the way from the untrained one to ``medium``."""


def train_policies(
    path: str | Path,
    *,
    task: str = "walker-walk",
    steps: int = 120_000,
    action_repeat: int = 2,
    hidden: int = 128,
    learning_rate: float = 1e-3,
    seed: int = 100,
    evaluate_every: int = 5_000,
    threads: int = 1,
    overwrite: bool = False,
    progress: bool = True,
) -> Path:
    """Train Stable-Baselines3's SAC from the state of a Control Suite task, and keep networks along the way.

    V-D4RL (Lu et al. 2023) records with SAC policies of several ages too. ``expert`` is the network with the highest
    return, ``medium`` the first one that reaches half of that, ``replay_0`` to ``replay_7`` are evenly spaced from
    the untrained network to ``medium``. Returns are means of five episodes with drawn actions.

    Args:
        path: the file to make (.safetensors).
        task: such as ``walker-walk``.
        steps: actions.
        action_repeat: control steps an action is held for.
        hidden: width of the two hidden layers.
        learning_rate: Adam's.
        seed: of everything.
        evaluate_every: steps between evaluations, each of which may become one of the kept networks; the untrained and
            the last network are evaluated too.
        threads: of torch.
        overwrite: replace an existing file.
        progress: show a progress bar.

    Returns:
        The path.

    Raises:
        UserError: a bad option, an unknown task, or Stable-Baselines3 is not installed.
    """
    path = Path(path)
    check_output_file(path, "policies", ".safetensors", [])
    if path.exists() and not overwrite:
        raise UserError(f"{path}: exists already; choose another file or pass --overwrite")
    _check({"steps": steps, "hidden": hidden, "evaluate_every": evaluate_every, "threads": threads})
    if not (learning_rate > 0 and math.isfinite(learning_rate)):
        raise UserError(f"learning_rate={learning_rate}: must be above 0")
    if not 0 <= seed < 2**32:
        raise UserError(f"seed={seed}: must be from 0 to {2**32 - 1}")
    environment = ControlStateEnv(task, action_repeat)
    agent = _agent(environment, hidden, learning_rate, seed, threads)
    kept: list[tuple[int, float, Network]] = []
    with tqdm(total=steps, unit=" steps", desc=f"SAC {task}", disable=not (progress and sys.stderr.isatty())) as bar:
        for done in (*range(0, steps, evaluate_every), steps):
            if done:
                agent.learn(done - kept[-1][0], reset_num_timesteps=False)
                bar.update(done - kept[-1][0])
            network = network_of(agent)
            reached = mean_return(ControlStateEnv(task, action_repeat), network, seed)
            kept.append((done, reached, network))
            bar.set_postfix_str(f"return {reached:.0f}")
            if progress:
                bar.write(f"{task}: {done} steps, return {reached:.0f}", file=sys.stderr)
    chosen = choose([reached for _, reached, _ in kept])
    facts: dict[str, Any] = {
        "task": environment.task.name,
        "action_repeat": action_repeat,
        "algorithm": "SAC (Stable-Baselines3)",
        "command": f"collect policies {path.name} --task {environment.task.name} --steps {steps} --action_repeat "
        f"{action_repeat} --hidden {hidden} --learning_rate {learning_rate} --seed {seed} --evaluate_every "
        f"{evaluate_every} --threads {threads}",
        "networks": {name: {"steps": kept[i][0], "return": round(kept[i][1], 1)} for name, i in chosen.items()},
    }
    write_policies(path, facts, {name: kept[i][2] for name, i in chosen.items()})
    return path


def _check(counts: Mapping[str, int]) -> None:
    for name, value in counts.items():
        if value < 1:
            raise UserError(f"{name}={value}: must be at least 1")


def choose(returns: Sequence[float]) -> dict[str, int]:
    """Which of the networks of a training, by their returns, become which behaviour: name -> index."""
    expert = int(np.argmax(returns))
    medium = int(np.argmax(np.asarray(returns) >= returns[expert] / 2))
    replayed = np.linspace(0, medium, REPLAYED).round().astype(int)
    return {"expert": expert, "medium": medium, **{f"replay_{i}": int(index) for i, index in enumerate(replayed)}}


def mean_return(environment: ControlStateEnv, network: Network, seed: int, episodes: int = 5) -> float:
    """Mean return of some episodes with drawn actions."""
    random = np.random.default_rng(seed)
    total = 0.0
    for _ in range(episodes):
        environment.task.reset(random)
        ended = False
        while not ended:
            reward, terminated, truncated = environment.task.step(network.act(environment.task.state(), random))
            total, ended = total + reward, terminated or truncated
    return total / episodes


def network_of(agent: Any) -> Network:
    """The weights of a Stable-Baselines3 SAC agent's actor."""
    actor = agent.policy.actor
    layers = [layer for layer in actor.latent_pi if hasattr(layer, "weight")] + [actor.mu, actor.log_std]
    weights = tuple(layer.weight.detach().cpu().numpy().copy() for layer in layers)
    return Network(weights, tuple(layer.bias.detach().cpu().numpy().copy() for layer in layers))


def _agent(environment: ControlStateEnv, hidden: int, learning_rate: float, seed: int, threads: int) -> Any:
    try:
        from stable_baselines3 import SAC
        from stable_baselines3.common.logger import Logger
    except ImportError as error:
        raise UserError("collect policies needs Stable-Baselines3: pip install 'repdib_lightning[rl]'") from error
    import torch

    torch.set_num_threads(threads)
    network: Mapping[str, Any] = {"net_arch": [hidden, hidden], "optimizer_kwargs": {"fused": True}}
    agent = SAC(
        "MlpPolicy",
        environment,
        learning_rate=learning_rate,
        learning_starts=1_000,
        policy_kwargs=dict(network),
        seed=seed,
        device="cpu",
    )
    agent.set_logger(Logger(folder=None, output_formats=[]))  # its own leaves a folder in /tmp at each learn
    return agent
