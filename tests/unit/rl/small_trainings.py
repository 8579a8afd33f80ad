"""A small bundle, and trainings on it as the verb builds them."""

from __future__ import annotations

import inspect
from pathlib import Path
from typing import Any

import torch
from stable_baselines3.common.logger import Logger
from torch import Tensor, nn

from repdib_lightning.bottlenecks import RepDIB
from repdib_lightning.bottlenecks.base import Bottleneck
from repdib_lightning.encoders import ConvolutionalEncoder
from repdib_lightning.export import save_bundle
from repdib_lightning.records import ArraySpec, DataSpec
from repdib_lightning.rl.finetune_dqn import finetune_dqn
from repdib_lightning.rl.options import DQNOptions
from repdib_lightning.rl.training import Training

PIXELS = 20
MAZE = {"size": 4, "episode_length": 12}
WIDTH = 8


def spec(frame_stack: int = 1) -> DataSpec:
    return DataSpec({"picture": ArraySpec((3 * frame_stack, PIXELS, PIXELS))}, frame_stack=frame_stack)


def pictures(count: int, seed: int = 0, frame_stack: int = 1) -> Tensor:
    generator = torch.Generator().manual_seed(seed)
    return torch.randint(0, 256, (count, 3 * frame_stack, PIXELS, PIXELS), generator=generator, dtype=torch.uint8)


def quantiser(**options: Any) -> RepDIB:
    return RepDIB(WIDTH, groups=2, codes=5, start="random", start_step=0, **options)


def make_bundle(folder: Path, bottleneck: Bottleneck | None = None, frame_stack: int = 1) -> Path:
    """A bundle whose running codebooks have moved, in averages that differ from fresh ones."""
    torch.manual_seed(7)
    encoder = ConvolutionalEncoder(spec(frame_stack), features=WIDTH, channels=4, strides=[3, 2])
    bottleneck = bottleneck or quantiser()
    with torch.no_grad():
        for seed in range(3):
            bottleneck.train()(encoder({"picture": pictures(16, seed, frame_stack)}))
    return save_bundle(folder, encoder.eval(), bottleneck.eval(), training={}, data={})


def training(bundle: Path | None, **changes: Any) -> Training:
    """The verb's defaults, made small."""
    defaults = {name: item.default for name, item in inspect.signature(finetune_dqn).parameters.items()}
    small = {
        "env": "SpiralWorld",
        "encoder": bundle,
        "env_options": dict(MAZE),
        "steps": 40,
        "learning_starts": 6,
        "batch_size": 8,
        "buffer_size": 50,
        "hidden": 16,
        "tau": 0.2,
        "features": WIDTH,
        "channels": 4,
        "device": "cpu",
    }
    given = defaults | small | changes
    made = Training(DQNOptions(**{name: given[name] for name in DQNOptions.__dataclass_fields__}))
    made.agent.set_logger(Logger(None, []))  # without one, learning makes a folder for its log
    return made


def copied(module: nn.Module) -> dict[str, Tensor]:
    return {name: value.detach().clone() for name, value in module.state_dict().items()}


def moved(module: nn.Module, before: dict[str, Tensor]) -> set[str]:
    return {name for name, value in module.state_dict().items() if not torch.equal(value, before[name])}
