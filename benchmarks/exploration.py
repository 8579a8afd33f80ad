"""What does an exploration spend its time on, and do several environments keep all cores busy?"""

from __future__ import annotations

import argparse
import multiprocessing
import os
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch
from gymnasium.vector import AsyncVectorEnv, AutoresetMode

from benchmarks.measuring import alternate
from benchmarks.reporting import claim, machine, table
from repdib_lightning.environments.control_env import ControlEnv
from repdib_lightning.rl.exploration.replay import ReplayBatch
from repdib_lightning.rl.exploration.stepping import Apart, Together

CONFIGURATION = "urlb/walker_repdib"
ACTIONS = 450
"""Of each environment; fewer than an episode has."""

ONE = "1 in this process"
REPEATS = 50
"""Calls of what takes little."""


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--device", default="cpu")
    options = parser.parse_args()
    print("## Exploration\n")
    print(f"{machine(options.device)}. `fit --config {CONFIGURATION}`, medians of {options.rounds} rounds in turn.\n")
    data, module = prepared(options.device)
    parts = alternate(parts_of(data, module), options.rounds, device=options.device)
    shares(parts, data)
    collections(data, options.rounds)


def prepared(device: str) -> tuple[Any, Any]:
    """Data module and model of the shipped configuration, untrained."""
    from repdib_lightning.cli import _prepare

    cli = _prepare(["--config", CONFIGURATION])
    cli.datamodule.setup("fit")
    module = cli.model.build(cli.datamodule.spec).to(device)
    module._writes_this_step = lambda: False
    optimizers = [_Unwrapped(optimizer) for optimizer in module.configure_optimizers()]
    module.optimizers = lambda: optimizers
    return cli.datamodule, module


class _Unwrapped:
    """An optimiser as a Trainer hands it out."""

    def __init__(self, optimizer: torch.optim.Optimizer) -> None:
        self.optimizer, self.zero_grad, self.step = optimizer, optimizer.zero_grad, optimizer.step


def parts_of(data: Any, module: Any) -> dict[str, Callable[[], object]]:
    """What one update and one action are made of."""
    environment: ControlEnv = data.environment()
    environment.reset(seed=0)
    random = np.random.default_rng(0)
    batch = batch_of(data, module, random)
    shown = {name: pairs[: data.environments, 0].cpu().numpy() for name, pairs in batch.observations.items()}
    noise = np.zeros((data.environments, data.actions), np.float32)
    action = random.uniform(-1.0, 1.0, data.actions)

    def step() -> None:
        if environment.task.step(action)[2]:
            environment.reset()

    return {
        "stepping": repeated(step),
        "rendering": repeated(lambda: environment.camera.see(environment.task)),
        "acting": repeated(lambda: module.act(shown, noise)),
        "updating": lambda: module.training_step(batch, 0),
    }


def repeated(call: Callable[[], object]) -> Callable[[], object]:
    """Many calls, since one alone begins with cold caches."""
    return lambda: [call() for _ in range(REPEATS)]


def batch_of(data: Any, module: Any, random: np.random.Generator) -> ReplayBatch:
    """Random pictures, as many as an update takes."""
    few, count = data.example(), data.batch_size
    pictures = {
        name: torch.from_numpy(random.integers(256, size=(count, *pairs.shape[1:]), dtype=np.uint8))
        for name, pairs in few.observations.items()
    }
    whole = ReplayBatch(
        observations=pictures,
        actions=few.actions[:1].repeat(count, 1),
        offsets=few.offsets[:1].repeat(count, 1),
        rows=few.rows[:1].repeat(count),
        returns=few.returns[:1].repeat(count),
        discounts=few.discounts[:1].repeat(count),
    )
    moved: ReplayBatch = module.transfer_batch_to_device(whole, module.device, 0)
    return moved


def shares(took: Any, data: Any) -> None:
    """How much of an action's time each part takes, without overlap."""
    each = {
        "stepping the simulator": took["stepping"] / REPEATS,
        "rendering": took["rendering"] / REPEATS,
        "acting (encoder and actor, all environments at once)": took["acting"] / REPEATS / data.environments,
        f"updating (every {data.update_every} actions)": took["updating"] / data.update_every,
    }
    whole = sum(each.values())
    rows = [[what, 1e3 * seconds, f"{100 * seconds / whole:.0f} %"] for what, seconds in each.items()]
    print(table(["of each action", "ms", "share"], rows) + "\n")
    frames = data.action_repeat / whole
    print(
        f"One after the other: {1 / whole:.0f} actions, {frames:.0f} frames, {1 / took['updating']:.1f} updates a s.\n"
    )


def collections(data: Any, rounds: int) -> None:
    """Random actions by several environments at once, in several ways."""
    cores = len(os.sched_getaffinity(0))
    opener = data.environment
    kinds: dict[str, Callable[[], tuple[float, float]]] = {
        ONE: lambda: stepped(Together([opener]), 1),
        f"8 in {cores} workers": lambda: stepped(Apart([opener] * 8, cores), 8),
        f"{cores} in {cores} workers": lambda: stepped(Apart([opener] * cores, cores), cores),
        "8, gymnasium's AsyncVectorEnv": lambda: stepped(Gymnasium([opener] * 8), 8),
        f"{cores}, gymnasium's AsyncVectorEnv": lambda: stepped(Gymnasium([opener] * cores), cores),
        f"limit: {cores} processes that never wait for each other": lambda: independent(opener, cores),
    }
    found = {name: [measure() for _ in range(rounds)] for name, measure in kinds.items()}
    rate = {name: float(np.median([speed for speed, _ in values])) for name, values in found.items()}
    busy = {name: float(np.median([share for _, share in values])) for name, values in found.items()}
    rows = [[name, rate[name], rate[name] / rate[ONE], f"{100 * busy[name]:.0f} %"] for name in kinds]
    print(f"Collecting alone, with random actions, {cores} cores; a step waits for all environments:\n")
    print(table(["environments", "actions a s", "1 in this process = 1", "of all cores busy"], rows) + "\n")
    ours, theirs = f"8 in {cores} workers", "8, gymnasium's AsyncVectorEnv"
    print(claim("8 in workers, relative to gymnasium's AsyncVectorEnv", rate[ours] / rate[theirs], at_least=1.2))
    print(claim("cores busy with 8 in workers, share", busy[ours], at_least=0.85))


class Gymnasium:
    """gymnasium's vector environment, a process an environment, stepped as ours are."""

    def __init__(self, openers: list[Any]) -> None:
        self._vector = AsyncVectorEnv(openers, context="spawn", autoreset_mode=AutoresetMode.DISABLED)
        self.processes = self._vector.processes

    def reset(self, seeds: list[int]) -> None:
        """Begin."""
        self._vector.reset(seed=seeds)

    def send(self, actions: np.ndarray) -> None:
        """Ask for a step."""
        self._vector.step_async(actions)

    def receive(self) -> None:
        """Wait for it."""
        self._vector.step_wait()

    def close(self) -> None:
        """Close."""
        self._vector.close()


def stepped(environments: Any, count: int) -> tuple[float, float]:
    """Actions a second, start-up left out, and the share of all cores' time that was used."""
    random = np.random.default_rng(0)
    environments.reset(list(range(count)))
    used, began = seconds_used(environments), time.perf_counter()
    for _ in range(ACTIONS):
        environments.send(random.uniform(-1.0, 1.0, (count, 6)).astype(np.float32))
        environments.receive()
    took = time.perf_counter() - began
    used = seconds_used(environments) - used
    environments.close()
    return ACTIONS * count / took, used / took / len(os.sched_getaffinity(0))


def independent(opener: Any, count: int) -> tuple[float, float]:
    """The same by processes each of which steps its own."""
    with multiprocessing.get_context("spawn").Pool(count) as pool:
        pool.map(int, range(count), 1)
        found = pool.starmap(alone, [(opener,)] * count, 1)
    return sum(speed for speed, _ in found), sum(share for _, share in found)


def alone(opener: Any) -> tuple[float, float]:
    """One environment in this process."""
    return stepped(Together([opener]), 1)


def seconds_used(environments: Any) -> float:
    """Processor time of this process and of those of the environments, so far."""
    workers = [process.pid for process in getattr(environments, "processes", [])]
    ticks = [Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[11:13] for pid in [os.getpid(), *workers]]
    return sum(int(tick) for pair in ticks for tick in pair) / os.sysconf("SC_CLK_TCK")


if __name__ == "__main__":
    main()
