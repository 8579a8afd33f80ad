"""Probes of one factor: fit on some episodes, score on others, and how much of the way from chance to perfect.

The paper scores a representation of the robot arm by probes of the time step, the picture and the cell (section on the
robot arm), and prints them relative to a run without bottleneck only. Here each probe has one direction, up:
a high score of a state factor is good, a high score of a noise factor is noise that leaked in. The ``mlp`` probe is the
``linear`` one with a learned correction, so it reads at least as much up to the noise of the inner folds.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import cached_property, partial

import numpy as np
import torch

from repdib_lightning.data.schema import FactorSpec
from repdib_lightning.errors import UserError, nearest
from repdib_lightning.evaluation.linear import PENALTIES, LinearMap, Ridge, fit_logistic
from repdib_lightning.evaluation.mlp import Fold, Task, fit_correction
from repdib_lightning.evaluation.splits import episode_folds

PROBES = ("linear", "mlp")
"""Probes of each factor, fitted unless others are named."""

DECODER = "decoder"
"""The probe of the pictures (:mod:`repdib_lightning.evaluation.decoder`)."""

GROUPS = "groups"
"""The probe of groups of codes (:mod:`repdib_lightning.evaluation.group_probe`)."""

RECOGNITION = "recognition"
"""The probe of a bundle's own classifier (:mod:`repdib_lightning.evaluation.recognition`)."""

KNOWN = (*PROBES, DECODER, GROUPS, RECOGNITION)

RIDGE_PENALTIES = (10.0, *PENALTIES, 1e-5, 1e-6)
ABSENT = -1e4
"""A logit so low that its class is never predicted, and small enough for float32."""

Predict = Callable[[np.ndarray], np.ndarray]
Fitted = tuple[float, LinearMap, list[LinearMap]]
"""The chosen penalty, the fit on all rows, and the fit on the rows that each fold leaves."""


@dataclass(frozen=True)
class Half:
    """Rows of one half: features (n, M) standardised, target (n,) int64 or (n, K) float64, episode (n,) int64."""

    features: np.ndarray
    target: np.ndarray
    episodes: np.ndarray

    @cached_property
    def linear(self) -> LinearProbe:
        """The linear probe of this half; kept, because the non-linear one starts from it."""
        return _fit_linear(self)


@dataclass(frozen=True)
class ProbeScore:
    """How well one probe reads one factor.

    Attributes:
        score: accuracy, or R2 (mean over dimensions); None where the factor does not vary in the score half.
        raw_kept: (score - chance) / (1 - chance), unclipped; None where chance is already perfect.
        kept: ``raw_kept`` clipped to [0, 1].
        choice: what the inner split of the fit half chose (penalty; for ``mlp`` also epochs, 0 being the linear probe).
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
        if name not in KNOWN:
            raise UserError(f"probes: unknown probe '{name}', {nearest(name, KNOWN)}")
    if not set(probes) & set(PROBES):
        raise UserError(f"probes: at least one of the factors is needed, {nearest('', PROBES)}")


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
    with one_thread():
        mapping, choice = _mapping(probe, fit, seed)
        predicted = fit.linear.decode(mapping(score.features))
    if fit.target.ndim == 1:
        value: float | None = float(np.mean(predicted == score.target))
    else:
        value = explained(predicted, score.target)
    return rate(value, chance(fit, score), choice)


@contextmanager
def one_thread() -> Iterator[None]:
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


@dataclass(frozen=True)
class LinearProbe:
    """A linear probe in the units it was fitted in.

    Attributes:
        target: (n,) classes as indices in [0, K), or (n, K) standardised values.
        decode: (n, K) logits or standardised predictions to classes (n,) or values (n, K) as stored.
        penalty: chosen by the inner folds.
        whole: fitted on all rows.
        without: fitted with this penalty on the rows that each fold leaves.
    """

    target: np.ndarray
    decode: Predict
    penalty: float
    whole: LinearMap
    without: list[LinearMap]


def _fit_linear(fit: Half) -> LinearProbe:
    folds = episode_folds(fit.episodes)
    if fit.target.ndim == 1:
        classes, index = np.unique(fit.target, return_inverse=True)
        return LinearProbe(index, lambda logits: classes[logits.argmax(1)], *_best_logistic(fit.features, index, folds))
    mean, scale = _moments(fit.target)
    target = (fit.target - mean) / scale
    return LinearProbe(target, lambda values: values * scale + mean, *_best_ridge(fit.features, target, folds))


def _mapping(probe: str, fit: Half, seed: int) -> tuple[Predict, dict[str, float]]:
    """(n, M) features to what ``LinearProbe.decode`` takes, and what the inner folds chose."""
    linear = fit.linear
    if probe == "linear":
        return linear.whole, {"penalty": linear.penalty}
    parts = [
        Fold(
            Task(fit.features[~rows], linear.target[~rows], base),
            fit.features[rows],
            partial(_error, target=linear.target[rows]),
        )
        for rows, base in zip(episode_folds(fit.episodes), linear.without, strict=True)
    ]
    corrected = fit_correction(Task(fit.features, linear.target, linear.whole), parts, seed)
    return corrected, {"penalty": linear.penalty, "epochs": corrected.epochs}


def _error(predicted: np.ndarray, target: np.ndarray) -> float:
    """Wrong rows, or squared error; summed over rows, so that folds add up."""
    wrong = predicted.argmax(1) != target if target.ndim == 1 else np.square(predicted - target)
    return float(wrong.sum())


def _best_logistic(features: np.ndarray, index: np.ndarray, folds: list[np.ndarray]) -> Fitted:
    """Logistic regression; the penalty with the best accuracy over the inner folds, the strongest of equals.

    Args:
        features: (n, M), standardised. index: (n,) classes in [0, K), each of which occurs. folds: held-out rows.
    """
    classes = int(index.max()) + 1
    paths = [_LogisticPath(features[~held_out], index[~held_out]) for held_out in folds]
    wrong: list[float] = []
    without: list[list[LinearMap]] = []
    for penalty in PENALTIES:
        without.append([path.next(penalty, classes) for path in paths])
        errors = [_error(m(features[rows]), index[rows]) for m, rows in zip(without[-1], folds, strict=True)]
        wrong.append(sum(errors))
        if wrong[-1] == 0.0:
            break
    best = int(np.argmin(wrong))
    final = _LogisticPath(features, index)
    whole = [final.next(penalty, classes) for penalty in PENALTIES[: best + 1]][-1]
    return PENALTIES[best], whole, without[best]


class _LogisticPath:
    """Logits of all K classes for weaker and weaker penalties, each fit started from the one before."""

    def __init__(self, features: np.ndarray, index: np.ndarray) -> None:
        self._features = features
        self._classes, self._index = np.unique(index, return_inverse=True)
        self._last: LinearMap | None = None

    def next(self, penalty: float, classes: int) -> LinearMap:
        self._last = fit_logistic(self._features, self._index, len(self._classes), penalty, self._last)
        return _widened(self._last, self._classes, classes)


def _widened(narrow: LinearMap, present: np.ndarray, classes: int) -> LinearMap:
    """Logits of the classes that a fold lacks are too low to be predicted, and to be corrected."""
    weight, bias = np.zeros((len(narrow.weight), classes)), np.full(classes, ABSENT)
    weight[:, present], bias[present] = narrow.weight, narrow.bias
    return LinearMap(weight, bias)


def _best_ridge(features: np.ndarray, target: np.ndarray, folds: list[np.ndarray]) -> Fitted:
    """Ridge regression; the penalty with the smallest squared error over the inner folds, the strongest of equals.

    Args:
        features: (n, M), standardised. target: (n, K), standardised. folds: held-out rows.
    """
    ridges = [Ridge(features[~held_out], target[~held_out]) for held_out in folds]
    errors = [
        sum(_error(r.solve(penalty)(features[rows]), target[rows]) for r, rows in zip(ridges, folds, strict=True))
        for penalty in RIDGE_PENALTIES
    ]
    penalty = RIDGE_PENALTIES[int(np.argmin(errors))]
    return penalty, Ridge(features, target).solve(penalty), [ridge.solve(penalty) for ridge in ridges]


def _moments(target: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    scale = target.std(0)
    return target.mean(0), np.where(scale > 0, scale, 1.0)
