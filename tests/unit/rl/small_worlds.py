"""Collections of small worlds."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from telling_world import ACTIONS, PICTURE, STEPS, Opener

from repdib_lightning.data.schema import FactorSpec
from repdib_lightning.records import ArraySpec
from repdib_lightning.rl.exploration.collection import Collection
from repdib_lightning.rl.exploration.replay import Replay, ReplayPlan
from repdib_lightning.rl.exploration.schedule import Schedule


def plan(episodes: int, **options: Any) -> ReplayPlan:
    factors = {
        "sum": FactorSpec("endogenous", "continuous", width=ACTIONS),
        "clock": FactorSpec("exogenous", "continuous"),
    }
    given: dict[str, Any] = {"observations": {"pixels": ArraySpec(PICTURE)}, "actions": ACTIONS, "steps": STEPS}
    return ReplayPlan(**{**given, "episodes": episodes, "factors": factors, "attributes": {"seed": 3}, **options})


def schedule(environments: int = 2, rounds: int = 4, **options: Any) -> Schedule:
    """So many rounds of episodes of all environments."""
    given: dict[str, Any] = {"action_repeat": 1, "episode": STEPS, "seed_frames": 0, "update_every": 2}
    return Schedule.of_frames(frames=rounds * environments * STEPS, environments=environments, **{**given, **options})


def collection(
    path: Path,
    when: Schedule,
    *,
    keep: int | None = None,
    processes: bool = False,
    seed: int = 0,
    ends: str = "cut",
    hold_out_every: int = 0,
    **options: Any,
) -> Collection:
    replay = Replay(path, plan(when.episodes, hold_out_every=hold_out_every), keep=keep, seed=seed, **options)
    return Collection([Opener(ends)] * when.environments, replay, when, seed=seed, processes=processes)


def policy(observations: dict[str, np.ndarray], noise: np.ndarray) -> np.ndarray:
    """Depends on every byte that is shown, and on the noise."""
    seen = observations["pixels"].reshape(len(noise), -1).astype(np.float64)
    weights = np.sin(np.arange(seen.shape[1] * noise.shape[1])).reshape(seen.shape[1], -1)
    return np.tanh(seen @ weights / 300 + 0.3 * noise)
