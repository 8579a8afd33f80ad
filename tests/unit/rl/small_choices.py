"""A world in which each step shows which of two actions is worth 1, and stores of it; small Decision Transformers."""

from __future__ import annotations

import inspect
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import torch

from repdib_lightning.bottlenecks import Identity, RepDIB
from repdib_lightning.data.writer import EpisodeWriter
from repdib_lightning.encoders import ConvolutionalEncoder
from repdib_lightning.export import save_bundle
from repdib_lightning.records import ActionSpec, ArraySpec, DataSpec
from repdib_lightning.rl.decision_transformer.network import DecisionTransformer, Sizes
from repdib_lightning.rl.decision_transformer.options import DTOptions
from repdib_lightning.rl.decision_transformer.states import LatentStates
from repdib_lightning.rl.finetune_dt import finetune_dt

PIXELS, STEPS, ACTIONS, FEATURES = 8, 6, 3, 6
VIEW = "frame"


class Choices(gymnasium.Env[np.ndarray, np.int64]):
    """The left or the right half of the picture is lit, anew in each step; naming it (0 or 1) is worth 1, 2 nothing.

    Episodes have ``steps`` steps, or up to three fewer by the seed where ``ragged``.
    """

    observation_space = gymnasium.spaces.Box(0, 255, (1, PIXELS, PIXELS), np.uint8)
    action_space = gymnasium.spaces.Discrete(ACTIONS)
    opened: list[Choices] = []  # noqa: RUF012 (cleared by those who look at it)

    def __init__(self, steps: int = STEPS, ragged: bool = False) -> None:
        self.steps, self.ragged = steps, ragged
        self.resets, self.taken = 0, []
        Choices.opened.append(self)

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[np.ndarray, dict[str, Any]]:
        super().reset(seed=seed)
        self.resets, self.done = self.resets + 1, 0
        self.length = self.steps - int(self.np_random.integers(4)) * self.ragged
        return self._shown(), {}

    def step(self, action: Any) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        assert self.action_space.contains(action) and self.done < self.length
        self.taken.append(int(action))
        reward, self.done = float(action == self.lit), self.done + 1
        return self._shown(), reward, False, self.done == self.length, {}

    def _shown(self) -> np.ndarray:
        self.lit = int(self.np_random.integers(2))
        picture = self.np_random.integers(0, 60, (1, PIXELS, PIXELS), dtype=np.uint8)
        picture[:, :, self.lit * PIXELS // 2 : (self.lit + 1) * PIXELS // 2] += 180
        return picture


def register_choices() -> str:
    name = "dt_tests/Choices-v0"
    if name not in gymnasium.registry:
        gymnasium.register(name, entry_point=Choices, disable_env_checker=True)
    return name


def record_choices(
    path: Path, episodes: int = 60, *, seed: int = 0, evaluation: Sequence[int] = (), **world: Any
) -> Path:
    """Episodes of random actions, of all degrees of skill: a share of each episode's actions is right."""
    random, recorded = np.random.default_rng(seed), []
    for episode in range(episodes):
        env, skill = Choices(**world), random.random()
        seen, actions, rewards = [env.reset(seed=seed * 1000 + episode)[0]], [], []
        ended = False
        while not ended:
            actions.append(env.lit if random.random() < skill else int(random.integers(ACTIONS)))
            picture, reward, _, ended, _ = env.step(actions[-1])
            seen.append(picture)
            rewards.append(reward)
        recorded.append((np.stack(seen), np.array(actions), np.array(rewards, np.float32)))
    return write_episodes(path, recorded, evaluation)


def write_episodes(
    path: Path,
    recorded: Sequence[tuple[np.ndarray, np.ndarray, np.ndarray]],
    evaluation: Sequence[int] = (),
    **stated: Any,
) -> Path:
    """A store of pictures (T + 1, C, H, W), actions (T,) and rewards (T,)."""
    with EpisodeWriter(
        path,
        rows=sum(len(seen) for seen, _, _ in recorded),
        episodes=len(recorded),
        observations={VIEW: ArraySpec(recorded[0][0].shape[1:])},
        actions=ActionSpec("discrete", ACTIONS),
        rewards=True,
        **stated,
    ) as writer:
        for number, (seen, actions, rewards) in enumerate(recorded):
            last = np.arange(len(actions)) == len(actions) - 1
            writer.add_episode(
                observations={VIEW: seen},
                actions=actions,
                rewards=rewards,
                terminations=np.zeros(len(actions), bool),
                truncations=last,
                evaluation=number in evaluation,
            )
    return path


def random_store(
    path: Path, lengths: Sequence[int] = (9, 2, 5, 14, 1, 7), evaluation: Sequence[int] = (2,), **stated: Any
) -> Path:
    """Episodes of so many steps with random pictures, actions and rewards."""
    random = np.random.default_rng(5)
    recorded = [
        (
            random.integers(0, 256, (steps + 1, 1, PIXELS, PIXELS), dtype=np.uint8),
            random.integers(0, ACTIONS, steps),
            random.normal(size=steps).astype(np.float32),
        )
        for steps in lengths
    ]
    return write_episodes(path, recorded, evaluation, **stated)


def choices_bundle(folder: Path, *, stack: int = 1, quantised: bool = False, features: int = FEATURES) -> Path:
    """A small encoder that nobody has trained, as a bundle."""
    torch.manual_seed(7)
    spec = DataSpec({VIEW: ArraySpec((stack, PIXELS, PIXELS))}, frame_stack=stack)
    encoder = ConvolutionalEncoder(spec, features=features, channels=4, strides=[2])
    bottleneck = RepDIB(features, groups=2, codes=5, start="random", start_step=0) if quantised else Identity(features)
    return save_bundle(folder, encoder.eval(), bottleneck.eval(), training={}, data={})


def network(seed: int = 0, **changes: Any) -> DecisionTransformer:
    """In evaluation mode; weights are larger than at the start, so that everything has its say."""
    given = {
        "actions": ACTIONS, "context": 5, "stride": 1, "beginnings": 20, "layers": 2, "heads": 2, "width": 8,
        "dropout": 0.0, "return_scale": 2.0,
    }  # fmt: skip
    sizes = Sizes(**{**given, **changes})
    torch.manual_seed(seed)
    made = DecisionTransformer(sizes, LatentStates(torch.zeros(FEATURES), torch.ones(FEATURES), sizes.width))
    with torch.no_grad():
        for weight in made.parameters():
            weight.add_(0.3 * torch.randn_like(weight))
    return made.eval()


def windows_of(sizes: Sizes, count: int = 4, steps: int | None = None, seed: int = 0) -> dict[str, torch.Tensor]:
    """Random arguments of a network's forward pass."""
    drawn, steps = torch.Generator().manual_seed(seed), steps or sizes.context
    return {
        "states": torch.randn(count, steps, FEATURES, generator=drawn),
        "returns": torch.randn(count, steps, generator=drawn),
        "actions": torch.randint(sizes.actions, (count, steps), generator=drawn),
        "first": torch.randint(sizes.stride * sizes.beginnings, (count,), generator=drawn),
    }


SMALL = {
    "env": "none", "epochs": 2, "context": 4, "layers": 2, "heads": 2, "width": 16, "batch_size": 16,
    "warmup_tokens": 50, "episodes": 4, "film": 0, "device": "cpu",
}  # fmt: skip
FRESH = {"channels": [4], "kernels": [4], "strides": [2], "frame_stack": 2}


def options(data: Path, **changes: Any) -> DTOptions:
    """The verb's defaults, made small."""
    defaults = {name: item.default for name, item in inspect.signature(finetune_dt).parameters.items()}
    return DTOptions.of({**defaults, **SMALL, "data": data, **changes})
