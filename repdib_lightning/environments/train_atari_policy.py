"""Trains networks that play an Atari game from pixels, for data of several qualities: ``collect atari_policy``."""

from __future__ import annotations

import math
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
from tqdm import tqdm

from repdib_lightning.data.outputs import check_output_file
from repdib_lightning.devices import resolve_device
from repdib_lightning.environments.atari_env import AtariEnv
from repdib_lightning.environments.atari_game import AtariGame
from repdib_lightning.environments.atari_network import NatureNetwork, write_atari_policy
from repdib_lightning.environments.atari_players import NetworkPlayer
from repdib_lightning.errors import UserError

STACK, IMAGE_SIZE, MAX_FRAMES = 4, 84, 27_000

_LAYERS = {
    "features_extractor.cnn.0": "layers.0",
    "features_extractor.cnn.2": "layers.2",
    "features_extractor.cnn.4": "layers.4",
    "features_extractor.linear.0": "layers.7",
    "q_net.0": "layers.9",
}
"""Layer of Stable-Baselines3's network -> of :class:`~repdib_lightning.environments.atari_network.NatureNetwork`."""


class OneLife(gymnasium.Wrapper[np.ndarray, np.integer, np.ndarray, np.integer]):
    """For training alone: a lost life ends an episode, the next one goes on in the same game; rewards are -1, 0 or 1
    (Mnih et al. 2015).
    """

    def __init__(self, environment: AtariEnv) -> None:
        super().__init__(environment)
        self._game, self._lives = environment.game, 0

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Begin a game, or go on with the next life."""
        if seed is not None or self._game.over or self._game.truncated:
            seen, info = self.env.reset(seed=seed, options=options)
        else:
            seen, _, over, truncated, info = self.env.step(np.int64(0))
            if over or truncated:
                seen, info = self.env.reset()
        self._lives = self._game.lives()
        return seen, info

    def step(self, action: np.integer) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """Hold an action for the frame skip."""
        seen, reward, over, truncated, info = self.env.step(action)
        lost, self._lives = self._game.lives() < self._lives, self._game.lives()
        return seen, float(np.sign(float(reward))), over or lost, truncated, info


def train_atari_policy(
    path: str | Path,
    *,
    game: str = "breakout",
    steps: int = 300_000,
    keep: list[int] | None = None,
    sticky: float = 0.0,
    frame_skip: int = 4,
    learning_rate: float = 1e-4,
    buffer: int = 50_000,
    learning_starts: int = 5_000,
    train_freq: int = 4,
    episodes: int = 3,
    seed: int = 100,
    device: str = "auto",
    threads: int = 1,
    overwrite: bool = False,
    progress: bool = True,
) -> Path:
    """Train Stable-Baselines3's DQN from the pixels of an Atari game, and keep networks of several ages.

    As Mnih et al. (2015), for a small budget: four stacked grey frames of 84 x 84, rewards clipped to -1, 0, 1, a lost
    life ends an episode; actions are random ever less often, down to 5 % after a tenth of the steps. ``collect atari``
    plays the networks as ``dqn`` (the last one) and ``dqn-STEPS``.

    Args:
        path: the file to make (.safetensors); no pickle.
        game: such as ``breakout``.
        steps: actions.
        keep: steps after which the network is kept, such as ``'[50000, 150000]'``; the last one always is. By default
            after an eighth, a quarter and half of the steps.
        sticky: probability that the console repeats the action before, each emulator frame.
        frame_skip: emulator frames an action is held for.
        learning_rate: Adam's.
        buffer: transitions that are remembered, 28 kB each.
        learning_starts: random actions before training starts.
        train_freq: actions for each step of training, a batch of 32.
        episodes: whole games over which the return of each kept network is measured (5 % random actions).
        seed: of everything.
        device: ``auto``, ``cpu``, ``cuda`` or ``mps``.
        threads: of torch.
        overwrite: replace an existing file.
        progress: show a progress bar, and the returns.

    Returns:
        The path.

    Raises:
        UserError: a bad option, an unknown game, or Stable-Baselines3, ale-py or OpenCV are not installed.
    """
    path = Path(path)
    check_output_file(path, "atari_policy", ".safetensors", [])
    if path.exists() and not overwrite:
        raise UserError(f"{path}: exists already; choose another file or pass --overwrite")
    counts = {"steps": steps, "buffer": buffer, "train_freq": train_freq, "episodes": episodes, "threads": threads}
    _check(counts, learning_starts, learning_rate, seed)
    ages = _ages(keep, steps)
    chosen = str(resolve_device(device))
    environment = AtariEnv(game, image_size=IMAGE_SIZE, frame_skip=frame_skip, frame_stack=STACK, sticky=sticky)
    options = {
        "learning_rate": learning_rate,
        "buffer_size": buffer,
        "learning_starts": learning_starts,
        "train_freq": train_freq,
    }
    states = _learn(OneLife(environment), steps, ages, {**options, "seed": seed, "device": chosen}, threads, progress)
    played = AtariGame(
        environment.game.name,
        image_size=IMAGE_SIZE,
        frame_skip=frame_skip,
        sticky=sticky,
        noop_max=30,
        max_frames=MAX_FRAMES,
    )
    reached = {}
    for age, state in states.items():
        network = NatureNetwork(STACK, IMAGE_SIZE, played.actions)
        network.load_state_dict(state)
        reached[age] = mean_return(played, network.eval(), seed, episodes)
        if progress:
            print(f"{played.name}: {age} steps, return {reached[age]:.1f}", file=sys.stderr)
    facts = {
        "game": played.name,
        "frame_skip": frame_skip,
        "sticky": sticky,
        "stack": STACK,
        "image_size": IMAGE_SIZE,
        "actions": played.actions,
        "algorithm": "DQN (Stable-Baselines3)",
        "command": f"collect atari_policy {path.name} --game {played.name} --steps {steps} --keep '{ages}' --sticky "
        f"{sticky} --frame_skip {frame_skip} --learning_rate {learning_rate} --buffer {buffer} --learning_starts "
        f"{learning_starts} --train_freq {train_freq} --episodes {episodes} --seed {seed} --threads {threads}",
        "networks": {age: {"return": round(value, 1)} for age, value in reached.items()},
    }
    write_atari_policy(path, facts, states)
    return path


def _check(counts: dict[str, int], learning_starts: int, learning_rate: float, seed: int) -> None:
    for name, value in counts.items():
        if value < 1:
            raise UserError(f"{name}={value}: must be at least 1")
    if learning_starts < 0:
        raise UserError(f"learning_starts={learning_starts}: must be at least 0")
    if not (learning_rate > 0 and math.isfinite(learning_rate)):
        raise UserError(f"learning_rate={learning_rate}: must be above 0")
    if not 0 <= seed < 2**32:
        raise UserError(f"seed={seed}: must be from 0 to {2**32 - 1}")


def _ages(keep: Sequence[int] | None, steps: int) -> list[int]:
    """After which steps networks are kept, ascending, the last one included."""
    chosen = [steps // 8, steps // 4, steps // 2] if keep is None else keep
    for age in chosen if keep is not None else ():
        if not 1 <= age <= steps:
            raise UserError(f"keep: {age} is not one of the {steps} steps")
    return sorted({*(age for age in chosen if age), steps})


def mean_return(game: AtariGame, network: NatureNetwork, seed: int, episodes: int) -> float:
    """Mean return of some whole games, as ``collect atari`` plays them."""
    player, total = NetworkPlayer(network, STACK), 0.0
    for episode in range(episodes):
        noops, sticking, random = (np.random.default_rng([seed, episode, stream]) for stream in range(3))
        game.reset(noops, sticking)
        player.begin()
        while not (game.over or game.truncated):
            total += game.step(player.act(game, random))
    return total / episodes


def _learn(
    environment: OneLife, steps: int, ages: Sequence[int], options: dict[str, Any], threads: int, progress: bool
) -> dict[int, dict[str, Any]]:
    """States of the network at the ages: steps -> state of a ``NatureNetwork``."""
    try:
        from stable_baselines3 import DQN
        from stable_baselines3.common.callbacks import BaseCallback
        from stable_baselines3.common.logger import Logger
    except ImportError as error:
        raise UserError("collect atari_policy needs Stable-Baselines3: pip install 'repdib_lightning[rl]'") from error
    import torch

    torch.set_num_threads(threads)
    kept: dict[int, dict[str, Any]] = {}
    bar = tqdm(total=steps, unit=" steps", desc=f"DQN {environment.env.unwrapped.game.name}", disable=not progress)  # type: ignore[attr-defined]

    class Keeping(BaseCallback):
        def _on_step(self) -> bool:
            bar.update(1)
            if self.num_timesteps in ages:
                kept[self.num_timesteps] = state_of(self.model)
            return True

    agent = DQN(
        "CnnPolicy",
        environment,
        exploration_fraction=0.1,
        exploration_final_eps=0.05,
        target_update_interval=1_000,
        optimize_memory_usage=True,
        replay_buffer_kwargs={"handle_timeout_termination": False},
        **options,
    )
    agent.set_logger(Logger(folder=None, output_formats=[]))  # its own leaves a folder in /tmp
    with bar:
        agent.learn(steps, callback=Keeping())
    return kept


def state_of(agent: Any) -> dict[str, Any]:
    """The state of a ``NatureNetwork`` that values as a Stable-Baselines3 DQN agent does."""
    state = agent.q_net.state_dict()
    return {
        f"{ours}.{part}": state[f"{theirs}.{part}"].detach().cpu().clone()
        for theirs, ours in _LAYERS.items()
        for part in ("weight", "bias")
    }
