"""How well factors can be predicted from groups of a latent, on rows that the predictor has not seen."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

STRENGTHS = (0.01, 0.1, 1.0, 10.0, 100.0)
"""Candidate inverse L2 penalties of the logistic regression, for a loss summed over rows; strongest penalty first."""

FOLDS = 3
TREES = 20
COLUMNS_A_SPLIT = 0.3
FEWEST_COLUMNS = 16


@dataclass(frozen=True)
class Task:
    """One factor to predict.

    Attributes:
        fit: (m,) rows to fit. known: (m,) their classes as indices in [0, K), each of which occurs.
        score: (k,) rows to score, without those whose class no fit row has. truth: (k,) their classes.
        origin: (m,) of the fit rows, numbers from 0; rows of one origin stay together where they are split again.
    """

    fit: np.ndarray
    score: np.ndarray
    known: np.ndarray
    truth: np.ndarray
    origin: np.ndarray

    @property
    def frequency(self) -> np.ndarray:
        """(K,) share of each class among the fit rows."""
        return np.bincount(self.known) / len(self.known)


def task_of(labels: np.ndarray, fit: np.ndarray, score: np.ndarray, origins: np.ndarray | None = None) -> Task | None:
    """Cut one factor into its halves; None where either half has one class, or they share fewer than two.

    Args:
        labels: (n,) int64 classes.
        fit, score: (n,) bool.
        origins: (n,) int64, which rows belong together; none do by default.
    """
    classes, known = np.unique(labels[fit], return_inverse=True)
    rows = np.flatnonzero(score)
    rows = rows[np.isin(labels[rows], classes)]
    truth = np.searchsorted(classes, labels[rows])
    if len(np.unique(truth)) < 2:
        return None
    inside = np.flatnonzero(fit)
    _, origin = np.unique(inside if origins is None else origins[inside], return_inverse=True)
    return Task(inside, rows, known.reshape(-1), truth, origin.reshape(-1))


def latent_features(latents: np.ndarray, fit: np.ndarray) -> list[np.ndarray]:
    """Latents of each group, shifted and scaled by the fit rows; a dimension that does not vary there is 0.

    Args:
        latents: (n, G, D). fit: (n,) bool.

    Returns:
        G arrays (n, D) float64.
    """
    wide = np.asarray(latents, np.float64)
    mean, deviation = wide[fit].mean(0), wide[fit].std(0)
    alive = deviation > 1e-6 * np.maximum(np.abs(mean), deviation.max(initial=0.0))
    scaled = (wide - mean) * np.where(alive, 1.0 / np.where(alive, deviation, 1.0), 0.0)
    return [np.ascontiguousarray(scaled[:, g]) for g in range(scaled.shape[1])]


def explicitness(features: np.ndarray, task: Task, seed: int) -> float:
    """How much of a factor's entropy a logistic regression predicts on new rows, at most 1.

    Hsu et al., "Disentanglement via latent quantization", NeurIPS 2023, the term of one factor in InfoE:
    (H_V(f) - H_V(f | z)) / H_V(f), both log losses, one of the regression and one of a predictor that sees nothing.
    They fit without penalty, weigh classes to be balanced, and score the rows that they fit, where a latent as wide as
    there are rows explains anything. Here the rows scored are new, so that the value falls below 0 where the
    regression is worse than the class frequencies of the fit rows; classes weigh what they weigh; and the L2 penalty is
    relaxed for as long as that lowers the loss over three inner folds of the fit rows.
    """
    blind = float(-np.log(task.frequency[task.truth]).sum())
    path = _Path(features, task)
    losses = [path.loss(strength) for strength in STRENGTHS[: _best_strength(features[task.fit], task, seed) + 1]]
    return 1.0 - losses[-1] / blind


def group_importance(blocks: list[np.ndarray], task: Task, seed: int) -> tuple[np.ndarray, float]:
    """How much each group matters to a random forest that predicts a factor, and how well it predicts.

    A forest rather than gradient boosting: it grows one tree for all classes instead of one a class and round (82
    species would need thousands). Each split looks at three tenths of the columns, since at the customary square root
    most splits see no column of the group that knows, and noise is credited. What is credited for a factor that cannot
    be predicted is all noise: read it beside the prediction.

    Args:
        blocks: G arrays (n, D) of features. task: the factor. seed: of the forest.

    Returns:
        (G,) sums of impurity importance over the columns of each group; they sum to 1, or are all 0 where no tree
        splits. And (accuracy - chance) / (1 - chance) on the score rows, chance being the fit rows' majority class.
    """
    from sklearn.ensemble import RandomForestClassifier

    together = np.concatenate(blocks, axis=1)
    columns = together.shape[1]
    seen = min(columns, max(FEWEST_COLUMNS, int(COLUMNS_A_SPLIT * columns)))
    forest = RandomForestClassifier(TREES, max_features=seen, min_samples_leaf=2, random_state=seed % 2**32)
    forest.fit(together[task.fit], task.known)
    edges = np.cumsum([0, *(block.shape[1] for block in blocks[:-1])])
    by_chance = float(np.mean(task.truth == task.frequency.argmax()))
    accuracy = float(np.mean(forest.predict(together[task.score]) == task.truth))
    return np.add.reduceat(forest.feature_importances_, edges), (accuracy - by_chance) / (1.0 - by_chance)


def tasks_of(
    factors: Mapping[str, np.ndarray], fit: np.ndarray, score: np.ndarray, origins: np.ndarray | None = None
) -> dict[str, Task]:
    """The factors that can be predicted; see :func:`task_of` for those left out."""
    tasks = {name: task_of(values, fit, score, origins) for name, values in factors.items()}
    return {name: task for name, task in tasks.items() if task is not None}


def _best_strength(features: np.ndarray, task: Task, seed: int) -> int:
    """Index of the first strength after which the loss over the inner folds grows, none of which splits an origin."""
    labels, fold = task.known, (np.random.default_rng(seed).permutation(task.origin.max() + 1) % FOLDS)[task.origin]
    tasks = [task_of(labels, fold != held_out, fold == held_out) for held_out in range(FOLDS)]
    paths = [_Path(features, task) for task in tasks if task is not None]
    best, smallest = 0, np.inf
    for step, strength in enumerate(STRENGTHS):
        total = sum(path.loss(strength) for path in paths)
        if total >= smallest:
            break
        best, smallest = step, total
    return best


class _Path:
    """Logistic regressions of one task under weaker and weaker penalties, each started from the one before."""

    def __init__(self, features: np.ndarray, task: Task) -> None:
        from sklearn.linear_model import LogisticRegression

        self._model = LogisticRegression(max_iter=2000, warm_start=True)
        self._inside, self._outside, self._task = features[task.fit], features[task.score], task

    def loss(self, strength: float) -> float:
        """Log loss on the score rows, in nats, summed."""
        chance = self._model.set_params(C=strength).fit(self._inside, self._task.known).predict_proba(self._outside)
        hit = chance[np.arange(len(self._task.truth)), self._task.truth]
        return float(-np.log(np.maximum(hit, 1e-12)).sum())
