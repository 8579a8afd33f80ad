"""Runs of exploration that nobody has trained, and agents that begin from them."""

from __future__ import annotations

import inspect
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import torch

from repdib_lightning.bottlenecks import RepDIB
from repdib_lightning.bottlenecks.base import Bottleneck
from repdib_lightning.encoders import ConvolutionalEncoder
from repdib_lightning.environments.control_env import ControlEnv
from repdib_lightning.environments.control_task import ControlTask
from repdib_lightning.records import ActionSpec, ArraySpec, DataSpec
from repdib_lightning.rl import finetune_online
from repdib_lightning.rl.exploration.ddpg import DDPG
from repdib_lightning.rl.exploration.snapshots import snapshot_folder, write_snapshot
from repdib_lightning.rl.online_ddpg import DDPGTraining
from repdib_lightning.rl.online_options import DDPGOptions, SACOptions

PIXELS, STACK, WIDTH, HIDDEN, REPEAT = 16, 2, 16, 16, 50
EPISODE = 1000 // REPEAT
TASK, OTHER_TASK = "cartpole-balance", "cartpole-swingup"
"""Of one action, and quickly simulated."""

SMALL = {
    "frames": 3000,
    "seed_frames": 1050,
    "batch_size": 16,
    "evaluate_every": 1000,
    "episodes": 2,
    "film": 0,
    "device": "cpu",
}
"""Three episodes, the first of random actions: 19 updates."""

FRESH = {"features": 8, "channels": 2, "strides": [2], "frame_stack": 2}
SCENE = {"image_size": PIXELS, "action_repeat": REPEAT}


def quantiser(**options: Any) -> RepDIB:
    return RepDIB(WIDTH, groups=4, codes=5, start="random", start_step=0, **options)


def parts(bottleneck: Bottleneck | None = None, seed: int = 7) -> tuple[ConvolutionalEncoder, Bottleneck]:
    """An encoder, and a bottleneck whose running codebooks have moved."""
    torch.manual_seed(seed)
    spec = DataSpec({"pixels": ArraySpec((3 * STACK, PIXELS, PIXELS))}, ActionSpec("continuous", 1), STACK)
    encoder, made = ConvolutionalEncoder(spec, features=WIDTH, channels=4, strides=[2]), bottleneck or quantiser()
    with torch.no_grad():
        for _ in range(3):
            made.train()(encoder({"pixels": torch.randint(0, 256, (16, 3 * STACK, PIXELS, PIXELS), dtype=torch.uint8)}))
    return encoder, made


def make_run(run: Path, frames: tuple[int, ...] = (1000, 2000), task: str = TASK, actions: int = 1) -> Path:
    """A run's folder with a snapshot after each of these frames, all different."""
    for count in frames:
        encoder, bottleneck = parts(seed=count)
        agent = DDPG(WIDTH, actions, hidden=HIDDEN)
        facts = {"task": task, "frames": count, **SCENE, "hidden": HIDDEN, "features": WIDTH, "actions": actions}
        write_snapshot(snapshot_folder(run, count), encoder, bottleneck, agent, training={}, data={}, facts=facts)
    return run


def _given(verb: Any, changes: dict[str, Any]) -> dict[str, Any]:
    defaults = {name: item.default for name, item in inspect.signature(verb).parameters.items()}
    return defaults | SMALL | changes


def ddpg_options(**changes: Any) -> DDPGOptions:
    """The verb's defaults, made small."""
    return DDPGOptions.of(_given(finetune_online.finetune_ddpg, changes))


def sac_options(**changes: Any) -> SACOptions:
    return SACOptions.of(_given(finetune_online.finetune_sac, {"hidden": HIDDEN} | changes))


def ddpg(encoder: Path | None, **changes: Any) -> DDPGTraining:
    """A training that is about to begin."""
    return DDPGTraining(ddpg_options(encoder=encoder, **changes))


class Toy(ControlEnv):
    """In place of the simulator: a colour that actions move; reward is how bright its red is.

    Args:
        task: of one action, ``walker-run`` has 6. options: ``image_size`` and ``action_repeat`` count.
    """

    def __init__(self, task: str, **options: Any) -> None:
        size, repeat = options.get("image_size", PIXELS), options.get("action_repeat", 2)
        self.task = object.__new__(ControlTask)  # of which nothing but these is looked at
        vars(self.task).update(name=task, action_repeat=repeat, steps=1000 // repeat)
        self.task.actions = 6 if task == "walker-run" else 1
        self.observation_space = gymnasium.spaces.Box(0, 255, (3, size, size), np.uint8)
        self.action_space = gymnasium.spaces.Box(-1.0, 1.0, (self.task.actions,), np.float32)

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[np.ndarray, dict[str, Any]]:
        gymnasium.Env.reset(self, seed=seed)
        self._colour, self._steps = self.np_random.random(3), 0
        return self._observe(), {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        assert np.isfinite(action).all()
        self._colour = np.clip(self._colour + np.array([0.2 * float(action[0]), 0.05, -0.05]), 0.0, 1.0)
        self._steps += 1
        return self._observe(), float(self._colour[0]), False, self._steps == self.task.steps, {}

    def _observe(self) -> np.ndarray:
        colour = np.rint(255 * self._colour).astype(np.uint8)[:, None, None]
        return np.ascontiguousarray(np.broadcast_to(colour, self.observation_space.shape))

    def close(self) -> None:
        pass


def play_toys(monkeypatch: Any) -> None:
    """Trainings open :class:`Toy`."""
    opened = "repdib_lightning.rl.online_training.open_task"
    monkeypatch.setattr(opened, lambda chosen, evaluation: Toy(**chosen))


def words(options: dict[str, Any]) -> list[str]:
    """As the command line takes them."""
    return [word for name, value in options.items() for word in (f"--{name}", str(value).replace(" ", ""))]
