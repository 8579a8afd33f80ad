"""Kernel ridge regression in closed form, its penalty and kernel chosen by held-out episodes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

PENALTIES = (1e-1, 1e-2, 1e-3, 1e-4, 1e-5, 1e-6, 1e-7, 1e-8, 1e-9)
"""Candidates, strongest first, relative to the number of rows."""

WIDTHS = (None, 0.5, 2.0)
"""Candidate widths of the Gaussian part, in median squared distances between rows; None leaves that part out."""


@dataclass(frozen=True)
class Kernel:
    """x.y / M + exp(-|x - y|^2 / (2 s^2)): a linear map, and what bends away from it.

    Attributes:
        width: 2 s^2, or None for the linear part alone.
    """

    width: float | None

    def __call__(self, first: np.ndarray, second: np.ndarray) -> np.ndarray:
        """(n, M) and (m, M) to (n, m) float64."""
        linear = first @ second.T / first.shape[1]
        return linear if self.width is None else linear + np.exp(-squared_distances(first, second) / self.width)


@dataclass(frozen=True)
class KernelRidge:
    """Predicts targets as weighted sums of the targets of the fit rows.

    Attributes:
        features: (n, M) of the fit rows. kernel, penalty: chosen. inverse: (n, n), (K + n penalty I)^-1.
    """

    features: np.ndarray
    kernel: Kernel
    penalty: float
    inverse: np.ndarray

    def weights(self, features: np.ndarray) -> np.ndarray:
        """(m, M) features to (m, n): prediction = weights @ targets of the fit rows (about their mean)."""
        return self.kernel(features, self.features) @ self.inverse


def fit_kernel_ridge(features: np.ndarray, gram: np.ndarray, folds: Sequence[np.ndarray]) -> KernelRidge:
    """Fit to targets that are given by their inner products alone, so that their width costs nothing.

    Args:
        features: (n, M), standardised.
        gram: (n, n) inner products of the targets, each less the mean over the rows.
        folds: (n,) bool masks of held-out rows; kernel and penalty are those with the smallest squared error over them.
    """
    features = np.asarray(features, np.float64)
    typical = _typical_distance(features)
    kernels = [Kernel(None if width is None else width * typical) for width in WIDTHS]
    errors: dict[tuple[Kernel, float], float] = {}
    for kernel in kernels:
        similarity = kernel(features, features)
        total = np.sum([_fold_errors(similarity, gram, held_out) for held_out in folds], axis=0)
        errors |= {(kernel, penalty): error for penalty, error in zip(PENALTIES, total, strict=True)}
    kernel, penalty = min(errors, key=lambda choice: errors[choice])
    values, vectors = np.linalg.eigh(kernel(features, features))
    inverse = (vectors / (np.maximum(values, 0.0) + penalty * len(features))) @ vectors.T
    return KernelRidge(features, kernel, penalty, inverse)


def squared_distances(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """(n, M) and (m, M) to (n, m), at least 0."""
    lengths = np.square(first).sum(1)[:, None] + np.square(second).sum(1)[None]
    return np.maximum(lengths - 2.0 * first @ second.T, 0.0)


def _fold_errors(similarity: np.ndarray, gram: np.ndarray, held_out: np.ndarray) -> np.ndarray:
    """Squared error on one fold for every penalty: |Y_h - S Y_t|^2 written out in inner products of Y."""
    inside, outside = np.flatnonzero(~held_out), np.flatnonzero(held_out)
    values, vectors = np.linalg.eigh(similarity[np.ix_(inside, inside)])
    onto = similarity[np.ix_(outside, inside)] @ vectors
    own, cross, among = _about_the_mean(gram, inside, outside)
    cross, among = cross @ vectors, vectors.T @ among @ vectors
    errors = []
    for penalty in PENALTIES:
        weights = onto / (np.maximum(values, 0.0) + penalty * len(inside))
        errors.append(own - 2.0 * np.sum(weights * cross) + np.sum((weights @ among) * weights))
    return np.array(errors)


def _about_the_mean(gram: np.ndarray, inside: np.ndarray, outside: np.ndarray) -> tuple[float, np.ndarray, np.ndarray]:
    """Inner products after the mean of the fit rows is taken off: held-out norms, held-out by fit, fit by fit."""
    among, cross = gram[np.ix_(inside, inside)], gram[np.ix_(outside, inside)]
    of_inside, of_outside, grand = among.mean(1), cross.mean(1), among.mean()
    own = float(np.sum(np.diag(gram)[outside] - 2.0 * of_outside + grand))
    cross = cross - of_outside[:, None] - of_inside[None] + grand
    return own, cross, among - of_inside[:, None] - of_inside[None] + grand


def _typical_distance(features: np.ndarray) -> float:
    """Median squared distance between distinct rows; 1 where all are equal."""
    distances = squared_distances(features, features)
    apart = distances[distances > 1e-9 * max(distances.max(), 1e-300)]
    return float(np.median(apart)) if len(apart) else 1.0
