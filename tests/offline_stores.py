"""Small stores and bundles for offline agents, and an environment whose best action is a linear function of what is
shown."""

from __future__ import annotations

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

PIXELS = 8
VIEW = "pixels"
TWO = ActionSpec("continuous", 2)


def write_offline(
    path: Path,
    *,
    lengths: Sequence[int] = (9, 2, 6, 7, 1, 8),
    evaluation: Sequence[int] = (2,),
    terminated: Sequence[int] = (0, 1),
    actions: ActionSpec | None = TWO,
    rewards: bool = True,
    largest: float = 1.0,
    seed: int = 0,
    size: int = PIXELS,
    **attributes: Any,
) -> Path:
    """Random pictures, actions and rewards; episodes end as told, all others are truncated."""
    random = np.random.default_rng(seed)
    with EpisodeWriter(
        path,
        rows=sum(lengths),
        episodes=len(lengths),
        observations={VIEW: ArraySpec((3, size, size))},
        actions=actions,
        rewards=rewards,
        attributes=attributes,
    ) as writer:
        for episode, length in enumerate(lengths):
            steps = length - 1
            last = np.arange(steps) == steps - 1
            ended = {
                "rewards": random.normal(size=steps).astype(np.float32),
                "terminations": last & (episode in terminated),
                "truncations": last & (episode not in terminated),
            }
            taken: Any = None
            if actions is not None and actions.kind == "continuous":
                taken = random.uniform(-largest, largest, (steps, actions.size)).astype(np.float32)
            elif actions is not None:
                taken = random.integers(0, actions.size, steps)
            writer.add_episode(
                observations={VIEW: random.integers(0, 256, (length, 3, size, size), dtype=np.uint8)},
                actions=taken,
                evaluation=episode in evaluation,
                **(ended if rewards else {}),
            )
    return path


def make_bundle(
    folder: Path, *, size: int = PIXELS, stack: int = 1, features: int = 16, quantised: bool = False, seed: int = 7
) -> Path:
    """A small encoder that nobody has trained, as a bundle."""
    torch.manual_seed(seed)
    spec = DataSpec({VIEW: ArraySpec((3 * stack, size, size))}, frame_stack=stack)
    encoder = ConvolutionalEncoder(spec, features=features, channels=4, strides=[2])
    bottleneck = Identity(features)
    if quantised:
        bottleneck = RepDIB(features, groups=2, codes=5, start="random", start_step=0)
    return save_bundle(folder, encoder.eval(), bottleneck.eval(), training={}, data={})


class Quadrants(gymnasium.Env[np.ndarray, np.ndarray]):
    """Each quarter of the picture shows one of four random numbers in [0, 1]; they are drawn anew in each step.

    The best action is a linear function of them and is rewarded by 1; it is worth less by the squared distance to it.
    """

    MOVES = 5
    best = np.array([[1.0, -1.0, 0.5, -0.5], [-0.5, 0.0, 1.0, -0.5]])
    observation_space = gymnasium.spaces.Box(0, 255, (3, PIXELS, PIXELS), np.uint8)
    action_space = gymnasium.spaces.Box(-1.0, 1.0, (2,), np.float32)

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[np.ndarray, dict[str, Any]]:
        super().reset(seed=seed)
        self._moves = 0
        return self._shown(), {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        reward = 1.0 - float(np.square(action - self.right()).sum())
        self._moves += 1
        return self._shown(), reward, False, self._moves == self.MOVES, {}

    def right(self) -> np.ndarray:
        """The best action now."""
        return np.clip(self.best @ self._numbers, -1.0, 1.0)

    def _shown(self) -> np.ndarray:
        self._numbers = self.np_random.random(4)
        levels = np.rint(255 * self._numbers).astype(np.uint8).reshape(2, 2)
        return np.broadcast_to(levels.repeat(PIXELS // 2, 0).repeat(PIXELS // 2, 1), (3, PIXELS, PIXELS)).copy()


def register_quadrants() -> str:
    name = "offline_tests/Quadrants-v0"
    if name not in gymnasium.registry:
        gymnasium.register(name, entry_point=Quadrants)
    return name


def record_quadrants(path: Path, episodes: int, *, skill: float, seed: int = 0) -> tuple[Path, float]:
    """Episodes of a policy that knows ``skill`` of the best action and draws the rest; and their mean return."""
    env, random, returns = Quadrants(), np.random.default_rng(seed), []
    moves = Quadrants.MOVES
    with EpisodeWriter(
        path,
        rows=episodes * (moves + 1),
        episodes=episodes,
        observations={VIEW: ArraySpec((3, PIXELS, PIXELS))},
        actions=ActionSpec("continuous", 2),
        rewards=True,
    ) as writer:
        for episode in range(episodes):
            seen, actions, rewards = [env.reset(seed=seed + episode)[0]], [], []
            for _ in range(moves):
                actions.append(skill * env.right() + (1.0 - skill) * random.uniform(-1.0, 1.0, 2))
                picture, reward, *_ = env.step(actions[-1])
                seen.append(picture)
                rewards.append(reward)
            last = np.arange(moves) == moves - 1
            writer.add_episode(
                observations={VIEW: np.stack(seen)},
                actions=np.array(actions, np.float32),
                rewards=np.array(rewards, np.float32),
                terminations=np.zeros(moves, bool),
                truncations=last,
            )
            returns.append(sum(rewards))
    return path, float(np.mean(returns))
