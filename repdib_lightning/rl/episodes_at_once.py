"""Plays several episodes of an environment at once, and films some of them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import gymnasium
import numpy as np

from repdib_lightning.export.gymnasium_wrapper import PrepareObservation
from repdib_lightning.records import DataSpec

Act = Callable[[dict[str, np.ndarray]], np.ndarray]
"""Observations name -> (n, *shape) to actions (n, A)."""


class EpisodesAtOnce:
    """One episode in each of several copies of an environment, the same ones every time.

    Args:
        environments: the copies. spec: of the encoder. seed: of the episodes.
    """

    def __init__(self, environments: Sequence[gymnasium.Env[Any, Any]], spec: DataSpec, seed: int) -> None:
        self._environments = [PrepareObservation(environment, spec) for environment in environments]
        self._spec, self._seed = spec, seed

    def run(self, act: Act, film: int = 0) -> tuple[np.ndarray, list[np.ndarray]]:
        """Play until every episode has ended.

        Args:
            act: the policy. film: how many of the episodes to film.

        Returns:
            returns (n,), undiscounted; and of each filmed episode the pictures that the agent saw, (T, H, W, 3) uint8.
        """
        seen = self._reset()
        returns, running = np.zeros(len(seen)), np.ones(len(seen), bool)
        films: list[list[np.ndarray]] = [[] for _ in range(film)]
        while running.any():
            for frames, observation, goes_on in zip(films, seen, running, strict=False):
                if goes_on:
                    frames.append(self._newest(observation))
            playing = np.flatnonzero(running)
            actions = act({name: np.stack([seen[i][name] for i in playing]) for name in self._spec.observations})
            for i, action in zip(playing, actions, strict=True):
                environment = self._environments[i]
                space: Any = environment.action_space
                seen[i], reward, terminated, truncated, _ = environment.step(np.clip(action, space.low, space.high))
                returns[i] += float(reward)
                running[i] = not (terminated or truncated)
        return returns, [np.stack(frames) for frames in films]

    def _reset(self) -> list[dict[str, np.ndarray]]:
        """Reset each copy once, to its own episode; what is seen there."""
        seeds = np.random.default_rng(self._seed).integers(2**31, size=len(self._environments)).tolist()
        return [env.reset(seed=seed)[0] for env, seed in zip(self._environments, seeds, strict=True)]

    def close(self) -> None:
        """Close the environments."""
        for environment in self._environments:
            environment.close()

    def _newest(self, observation: dict[str, np.ndarray]) -> np.ndarray:
        """(H, W, 3) uint8: the newest frame of all pictures, side by side; one of grey levels is shown in grey."""
        pictures = {name: array.shape for name, array in self._spec.observations.items() if array.is_image}
        height = max(shape[1] for shape in pictures.values())
        views = []
        for name, shape in pictures.items():
            frame = observation[name][-(shape[0] // self._spec.frame_stack) :]
            coloured = frame if len(frame) == 3 else np.repeat(frame[:1], 3, axis=0)
            views.append(np.pad(coloured, ((0, 0), (0, height - shape[1]), (0, 0))))
        return np.concatenate(views, axis=2).transpose(1, 2, 0)
