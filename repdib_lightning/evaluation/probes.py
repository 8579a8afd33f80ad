"""Probes of one factor: fit on some episodes, score on others, and how much of the way from chance to perfect.

The paper scores a representation of the robot arm by probes of the time step, the picture and the cell (section on the
robot arm), and prints them relative to a run without bottleneck only. Here each probe has one direction, up:
a high score of a state factor is good, a high score of a noise factor is noise that leaked in.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field

import numpy as np
import torch

from repdib_lightning.data.schema import FactorSpec
from repdib_lightning.errors import UserError, nearest
from repdib_lightning.evaluation.linear import PENALTIES, LinearMap, Ridge, fit_logistic
from repdib_lightning.evaluation.mlp import fit_mlp
from repdib_lightning.evaluation.splits import episode_folds

PROBES = ("linear", "mlp")
RIDGE_PENALTIES = (10.0, *PENALTIES, 1e-5, 1e-6)


@dataclass(frozen=True)
class Half:
    """Rows of one half: features (n, M) standardised, target (n,) int64 or (n, K) float64, episode (n,) int64."""

    features: np.ndarray
    target: np.ndarray
    episodes: np.ndarray


@dataclass(frozen=True)
class ProbeScore:
    """How well one probe reads one factor.

    Attributes:
        score: accuracy, or R2 (mean over dimensions); None where the factor does not vary in the score half.
        raw_kept: (score - chance) / (1 - chance), unclipped; None where chance is already perfect.
        kept: ``raw_kept`` clipped to [0, 1].
        choice: what the inner split of the fit half chose (penalty, or epochs).
    """

    score: float | None
    raw_kept: float | None
    kept: float | None
    choice: dict[str, float] = field(default_factory=dict)


class Standardiser:
    """Shift and scale every latent dimension by the mean and deviation of the fit half.

    Dimensions that do not vary there (up to rounding) become exactly zero: they tell the probe nothing, and scaling
    them up would feed it noise.
    """

    def __init__(self, features: np.ndarray) -> None:
        wide = np.asarray(features, np.float64)
        self.mean, deviation = wide.mean(0), wide.std(0)
        alive = deviation > 1e-6 * np.maximum(np.abs(self.mean), deviation.max(initial=0.0))
        self.scale = np.where(alive, 1.0 / np.where(alive, deviation, 1.0), 0.0)

    def __call__(self, features: np.ndarray) -> np.ndarray:
        """(n, M) to standardised (n, M) float64."""
        return (np.asarray(features, np.float64) - self.mean) * self.scale


def check_probes(probes: tuple[str, ...]) -> None:
    """Raises UserError if a probe is unknown or none is given."""
    for name in probes:
        if name not in PROBES:
            raise UserError(f"probes: unknown probe '{name}', {nearest(name, PROBES)}")
    if not probes:
        raise UserError(f"probes: at least one is needed {nearest('', PROBES)}")


def as_target(values: np.ndarray, spec: FactorSpec) -> np.ndarray:
    """Stored factor values to (n,) int64 classes, or (n, K) float64."""
    if spec.scale == "categorical":
        return np.asarray(values).reshape(len(values)).astype(np.int64)
    return np.asarray(values, np.float64).reshape(len(values), -1)


def chance(fit: Half, score: Half) -> float:
    """Score of a predictor that ignores the representation: the fit half's majority class, or R2 = 0."""
    if fit.target.ndim == 2:
        return 0.0
    classes, counts = np.unique(fit.target, return_counts=True)
    return float(np.mean(score.target == classes[counts.argmax()]))


def measure(probe: str, fit: Half, score: Half, seed: int) -> ProbeScore:
    """Fit one probe (``linear`` or ``mlp``) on one half and score it on the other; every row there counts.

    A class that occurs only in the score half cannot be predicted, so its rows count as wrong.
    """
    with _one_thread():
        if fit.target.ndim == 1:
            fitted, choice = (_linear_classes if probe == "linear" else _mlp_classes)(fit, seed)
            value: float | None = float(np.mean(fitted(score.features) == score.target))
        else:
            fitted, choice = (_linear_values if probe == "linear" else _mlp_values)(fit, seed)
            value = explained(fitted(score.features), score.target)
    return rate(value, chance(fit, score), choice)


@contextmanager
def _one_thread() -> Iterator[None]:
    """Probes are so small that a second thread gains nothing, costs 10x on a busy machine, and moves last digits."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def rate(score: float | None, by_chance: float, choice: dict[str, float]) -> ProbeScore:
    """Place a score on the way from chance to perfect (1)."""
    if score is None or by_chance >= 1.0:
        return ProbeScore(score, None, None, choice)
    raw = (score - by_chance) / (1.0 - by_chance)
    return ProbeScore(score, raw, float(np.clip(raw, 0.0, 1.0)), choice)


def explained(predicted: np.ndarray, target: np.ndarray) -> float | None:
    """R2, mean over the dimensions that vary in (n, K) targets; None if none does."""
    total = np.square(target - target.mean(0)).sum(0)
    left = np.square(target - predicted).sum(0)
    varies = total > 1e-12 * len(target) * np.maximum(np.square(target).mean(0), 1e-300)
    return float(np.mean(1.0 - left[varies] / total[varies])) if varies.any() else None


Predict = Callable[[np.ndarray], np.ndarray]


def _linear_classes(fit: Half, seed: int) -> tuple[Predict, dict[str, float]]:
    """Logistic regression; the penalty with the best accuracy over the inner folds, the strongest of equals."""
    folds = episode_folds(fit.episodes)
    paths = [_LogisticPath(fit.features[~held_out], fit.target[~held_out]) for held_out in folds]
    right: list[int] = []
    for penalty in PENALTIES:
        predicts = [path.next(penalty) for path in paths]
        hits = [p(fit.features[rows]) == fit.target[rows] for p, rows in zip(predicts, folds, strict=True)]
        right.append(int(sum(hit.sum() for hit in hits)))
        if right[-1] == len(fit.target):
            break
    best = int(np.argmax(right))
    final = _LogisticPath(fit.features, fit.target)
    return [final.next(penalty) for penalty in PENALTIES[: best + 1]][-1], {"penalty": PENALTIES[best]}


class _LogisticPath:
    """Classifiers for weaker and weaker penalties, each started from the one before."""

    def __init__(self, features: np.ndarray, labels: np.ndarray) -> None:
        self._features = features
        self._classes, self._index = np.unique(labels, return_inverse=True)
        self._last: LinearMap | None = None

    def next(self, penalty: float) -> Predict:
        self._last = fit_logistic(self._features, self._index, len(self._classes), penalty, self._last)
        return _class_of(self._last, self._classes)


def _class_of(logits: Predict, classes: np.ndarray) -> Predict:
    return lambda features: classes[logits(features).argmax(1)]


def _linear_values(fit: Half, seed: int) -> tuple[Predict, dict[str, float]]:
    """Ridge regression; the penalty with the smallest squared error over the inner folds, the strongest of equals."""
    mean, scale = _moments(fit.target)
    target = (fit.target - mean) / scale
    errors = np.zeros(len(RIDGE_PENALTIES))
    for held_out in episode_folds(fit.episodes):
        ridge = Ridge(fit.features[~held_out], target[~held_out])
        for i, penalty in enumerate(RIDGE_PENALTIES):
            errors[i] += np.square(ridge.solve(penalty)(fit.features[held_out]) - target[held_out]).sum()
    penalty = RIDGE_PENALTIES[int(errors.argmin())]
    solution = Ridge(fit.features, target).solve(penalty)
    return (lambda features: solution(features) * scale + mean), {"penalty": penalty}


def _moments(target: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    scale = target.std(0)
    return target.mean(0), np.where(scale > 0, scale, 1.0)


def _mlp_classes(fit: Half, seed: int) -> tuple[Predict, dict[str, float]]:
    classes, index = np.unique(fit.target, return_inverse=True)
    network = fit_mlp(fit.features, index, len(classes), episode_folds(fit.episodes)[0], seed)
    return _class_of(network, classes), {"epochs": network.epochs}


def _mlp_values(fit: Half, seed: int) -> tuple[Predict, dict[str, float]]:
    mean, scale = _moments(fit.target)
    target = (fit.target - mean) / scale
    network = fit_mlp(fit.features, target, target.shape[1], episode_folds(fit.episodes)[0], seed)
    return (lambda features: network(features) * scale + mean), {"epochs": network.epochs}
