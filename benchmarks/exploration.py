"""What does an exploration spend its time on, and do several environments keep all cores busy?"""

from __future__ import annotations

import argparse
import os
import tempfile
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from benchmarks.measuring import alternate
from benchmarks.reporting import claim, machine, table
from repdib_lightning.environments.control_env import ControlEnv
from repdib_lightning.rl.exploration.collection import Collection
from repdib_lightning.rl.exploration.replay import Replay, ReplayBatch
from repdib_lightning.rl.exploration.schedule import Schedule

CONFIGURATION = "urlb/walker_repdib"
ACTIONS = 500


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
        "stepping": step,
        "rendering": lambda: environment.camera.see(environment.task),
        "acting": lambda: module.act(shown, noise),
        "updating": lambda: module.training_step(batch, 0),
    }


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
        "stepping the simulator": took["stepping"],
        "rendering": took["rendering"],
        "acting (encoder and actor, all environments at once)": took["acting"] / data.environments,
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
    """Random actions by several environments, in this process and in processes of their own."""
    cores = len(os.sched_getaffinity(0))
    rates: dict[str, list[float]] = {}
    busy: dict[str, list[float]] = {}
    kinds = {"1 in this process": (1, False), "2 in this process": (2, False)}
    kinds |= {f"{count} in {count} processes": (count, True) for count in (2, 4)}
    for _ in range(rounds):
        for name, (count, processes) in kinds.items():
            rate, share = collected(data, count, processes)
            rates.setdefault(name, []).append(rate)
            busy.setdefault(name, []).append(share)
    middle = {name: float(np.median(values)) for name, values in rates.items()}
    rows = [
        [name, middle[name], middle[name] / middle["1 in this process"], f"{100 * np.median(busy[name]):.0f} %"]
        for name in kinds
    ]
    print(f"Collecting alone, with random actions, {cores} cores:\n")
    print(table(["environments", "actions a s", "1 in this process = 1", "of all cores busy"], rows) + "\n")
    best = max(name for name in kinds if "processes" in name)
    print(claim(f"{best}, relative to 1 in this process", middle[best] / middle["1 in this process"], at_least=1.5))
    print(claim(f"cores busy with {best}, share", float(np.median(busy[best])), at_least=0.85))


def collected(data: Any, count: int, processes: bool) -> tuple[float, float]:
    """Actions a second, start-up left out, and the share of all cores' time that was used."""
    schedule = Schedule(count, data.plan.steps, ACTIONS * count, 0, ACTIONS * count, 0)
    plan = replace(data.plan, episodes=schedule.episodes)
    with tempfile.TemporaryDirectory() as folder:
        replay = Replay(Path(folder) / "replay.h5", plan, seed=0)
        collection = Collection([data.environment] * count, replay, schedule, seed=0, processes=processes)
        random = np.random.default_rng(0)

        def act(observations: object, noise: np.ndarray) -> np.ndarray:
            return random.uniform(-1.0, 1.0, noise.shape).astype(np.float32)

        used, began = seconds_used(collection), time.perf_counter()
        collection.finish(act)
        took = time.perf_counter() - began
        used = seconds_used(collection) - used
        collection.close()
    return schedule.total / took, used / took / len(os.sched_getaffinity(0))


def seconds_used(collection: Collection) -> float:
    """Processor time of this process and of those of the environments, so far."""
    workers = [process.pid for process in getattr(collection._environments, "processes", [])]
    ticks = [Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[11:13] for pid in [os.getpid(), *workers]]
    return sum(int(tick) for pair in ticks for tick in pair) / os.sysconf("SC_CLK_TCK")


if __name__ == "__main__":
    main()
