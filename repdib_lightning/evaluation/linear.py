"""Linear probes solved to their optimum: multinomial logistic regression and ridge regression."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

PENALTIES = (1.0, 1e-1, 1e-2, 1e-3, 1e-4)
"""Candidate weights of the L2 penalty, strongest first, relative to a loss averaged over rows."""


@dataclass(frozen=True)
class LinearMap:
    """``x @ weight + bias``: weight (M, K), bias (K,), both float64."""

    weight: np.ndarray
    bias: np.ndarray

    def __call__(self, features: np.ndarray) -> np.ndarray:
        """Map (n, M) to (n, K)."""
        return features @ self.weight + self.bias


def fit_logistic(
    features: np.ndarray,
    labels: np.ndarray,
    classes: int,
    penalty: float,
    start: LinearMap | None = None,
    max_steps: int = 500,
) -> LinearMap:
    """Minimise mean cross-entropy + penalty / 2 * |weight|^2 (the bias is free) with full-batch L-BFGS in float64.

    Args:
        features: (n, M), standardised.
        labels: (n,) int64 in [0, K); every class occurs.
        classes: K.
        penalty: weight of the L2 term; the problem is strictly convex in the weight for penalty > 0.
        start: where to begin, e.g. the optimum of a stronger penalty; zero by default.
        max_steps: bound on L-BFGS iterations.
    """
    x = torch.from_numpy(np.asarray(features, np.float64))
    y = torch.from_numpy(np.asarray(labels, np.int64))
    begin = start or LinearMap(np.zeros((x.shape[1], classes)), np.zeros(classes))
    weight = torch.from_numpy(begin.weight).clone().requires_grad_()
    bias = torch.from_numpy(begin.bias).clone().requires_grad_()
    optimiser = torch.optim.LBFGS(
        [weight, bias],
        max_iter=max_steps,
        history_size=20,
        tolerance_grad=1e-6,
        tolerance_change=1e-10,
        line_search_fn="strong_wolfe",
    )

    def closure() -> Tensor:
        optimiser.zero_grad()
        loss = torch.nn.functional.cross_entropy(x @ weight + bias, y) + penalty / 2 * weight.square().sum()
        loss.backward()
        return loss

    with torch.inference_mode(False), torch.enable_grad():
        optimiser.step(closure)
    return LinearMap(weight.detach().numpy(), bias.detach().numpy())


class Ridge:
    """Ridge regression for every penalty at the price of one eigendecomposition, in float64.

    Minimises mean squared error + penalty * |weight|^2, the bias free.

    Args:
        features: (n, M).
        targets: (n, K).
    """

    def __init__(self, features: np.ndarray, targets: np.ndarray) -> None:
        x, y = np.asarray(features, np.float64), np.asarray(targets, np.float64)
        self._x_mean, self._y_mean = x.mean(0), y.mean(0)
        centred = x - self._x_mean
        self._values, self._vectors = np.linalg.eigh(centred.T @ centred / len(x))
        self._cross = self._vectors.T @ (centred.T @ (y - self._y_mean) / len(x))

    def solve(self, penalty: float) -> LinearMap:
        """Closed form: weight = (X'X / n + penalty I)^-1 X'Y / n on centred data."""
        shrunk = self._cross / (np.maximum(self._values, 0.0) + penalty)[:, None]
        weight = self._vectors @ shrunk
        return LinearMap(weight, self._y_mean - self._x_mean @ weight)
