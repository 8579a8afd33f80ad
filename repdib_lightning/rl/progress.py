"""Evaluates an agent while it learns: one row of progress.csv each time, and the best policy so far."""

from __future__ import annotations

import csv
import sys
from pathlib import Path
from typing import Any

import numpy as np
from stable_baselines3.common.callbacks import BaseCallback
from tqdm import tqdm

from repdib_lightning.evaluation.coverage import covered, visitation_entropy
from repdib_lightning.rl.evaluation import Act, EpisodeEvaluation, MazeEvaluation
from repdib_lightning.rl.features import BottleneckFeatures
from repdib_lightning.rl.options import PROGRESS
from repdib_lightning.rl.visits import CountVisits

POLICY = "policy.zip"
_SHOWN = ("eval/return", "eval/success", "train/coverage")


class Progress(BaseCallback):
    """Writes ``progress.csv`` and ``policy.zip`` into a folder, and moves a bar where there is a terminal.

    Columns: ``step``; ``eval/...`` of the evaluation; ``train/coverage`` and ``train/entropy`` of the visits since the
    beginning; ``train/loss`` of the last update; ``train/exploration``; what the bottleneck told of the last update.

    Args:
        folder: of the run.
        every: environment steps between evaluations.
        evaluation: None in training without a goal.
        act: the greedy policy.
        visits: counts of a maze, or None.
    """

    def __init__(
        self,
        folder: Path,
        every: int,
        evaluation: MazeEvaluation | EpisodeEvaluation | None,
        act: Act,
        visits: CountVisits | None,
    ) -> None:
        super().__init__()
        self.folder, self.every, self.evaluation, self.act, self.visits = folder, every, evaluation, act, visits
        self.rows: list[dict[str, float]] = []
        self._best: tuple[float, float] | None = None
        self._fields: list[str] = []

    def _on_training_start(self) -> None:
        self._bar = tqdm(total=self.locals["total_timesteps"], unit=" steps", disable=not sys.stderr.isatty())

    def _on_training_end(self) -> None:
        self._bar.close()

    def _on_step(self) -> bool:
        self._bar.update()
        if self.num_timesteps % self.every == 0 or self.num_timesteps == self.locals["total_timesteps"]:
            self._add(self._evaluated() | self._trained())
        return True

    def _evaluated(self) -> dict[str, float]:
        if self.evaluation is None:
            self.model.save(self.folder / POLICY)
            return {}
        found = self.evaluation.run(self.act)
        score = (found.get("success", 0.0), found["return"])
        if self._best is None or score > self._best:
            self._best = score
            self.model.save(self.folder / POLICY)
        return {f"eval/{name}": value for name, value in found.items()}

    def _trained(self) -> dict[str, float]:
        found: dict[str, float] = {"train/exploration": float(self.model.exploration_rate)}  # type: ignore[attr-defined]
        if self.visits is not None:
            found["train/coverage"] = covered(self.visits.visits)
            found["train/entropy"] = visitation_entropy(self.visits.visits)
        logged: dict[str, Any] = self.logger.name_to_value
        if "train/loss" in logged:
            found["train/loss"] = float(logged["train/loss"])
        features = self.model.policy.q_net.features_extractor  # type: ignore[union-attr, operator]
        if isinstance(features, BottleneckFeatures):
            found |= {f"train/{name}": float(value) for name, value in features.latest.items()}
        return found

    def _add(self, values: dict[str, float]) -> None:
        self.rows.append({"step": self.num_timesteps, **values})
        self._bar.set_postfix({name: f"{values[name]:.2f}" for name in _SHOWN if name in values})
        new = [name for name in self.rows[-1] if name not in self._fields]
        self._fields += new
        rows = self.rows if new else self.rows[-1:]
        with open(self.folder / PROGRESS, "w" if new else "a", newline="") as file:
            table = csv.DictWriter(file, self._fields, restval="")
            if new:
                table.writeheader()
            table.writerows({name: _short(value) for name, value in row.items()} for row in rows)

    def curve(self, name: str) -> np.ndarray:
        """(n,) values of a column, in order."""
        return np.array([row[name] for row in self.rows if name in row])


def _short(value: float) -> float | str:
    return value if isinstance(value, int) else f"{value:.6g}"
