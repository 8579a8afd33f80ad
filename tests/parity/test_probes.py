"""The probes beside small, slow, obviously right versions of themselves."""

import math

import numpy as np
import pytest
from scipy.optimize import minimize

from repdib_lightning.evaluation.codes import mutual_information
from repdib_lightning.evaluation.linear import Ridge, fit_logistic
from repdib_lightning.evaluation.probes import explained


def logistic_loss(flat, features, labels, classes, penalty):
    """Mean negative log likelihood, one row at a time, and the penalty."""
    weight, bias = flat[:-classes].reshape(-1, classes), flat[-classes:]
    total = 0.0
    for x, y in zip(features, labels, strict=True):
        logits = x @ weight + bias
        total -= logits[y] - math.log(sum(math.exp(value) for value in logits))
    return total / len(labels) + penalty / 2 * float((weight**2).sum())


@pytest.fixture(scope="module")
def table():
    generator = np.random.default_rng(0)
    labels = np.arange(40) % 3
    features = generator.normal(size=(40, 2)) + np.eye(3)[labels][:, :2]
    return features, labels


@pytest.mark.parametrize("penalty", [1.0, 1e-2])
def test_logistic_regression_reaches_the_optimum_of_the_slow_loss(table, penalty):
    features, labels = table
    fitted = fit_logistic(features, labels, 3, penalty)
    slow = minimize(logistic_loss, np.zeros(9), (features, labels, 3, penalty), tol=1e-10)
    ours = logistic_loss(np.concatenate([fitted.weight.ravel(), fitted.bias]), features, labels, 3, penalty)
    assert ours == pytest.approx(slow.fun, abs=1e-8)
    np.testing.assert_allclose(fitted.weight, slow.x[:-3].reshape(2, 3), atol=1e-3)


def test_logistic_regression_has_no_gradient_left_on_wide_features():
    generator = np.random.default_rng(1)
    labels = generator.integers(5, size=300)
    features = generator.normal(size=(300, 64)) + generator.normal(size=(5, 64))[labels]
    warm = fit_logistic(features, labels, 5, 1e-1)
    for start in (None, warm):
        fitted = fit_logistic(features, labels, 5, 1e-4, start)
        logits = fitted(features)
        share = np.exp(logits - logits.max(1, keepdims=True))
        share /= share.sum(1, keepdims=True)
        gradient = features.T @ (share - np.eye(5)[labels]) / 300 + 1e-4 * fitted.weight
        assert np.abs(gradient).max() < 1e-4


@pytest.mark.parametrize("penalty", [1e-6, 0.3, 10.0])
@pytest.mark.parametrize("rows", [60, 5])
def test_ridge_is_the_solution_of_the_normal_equations(penalty, rows):
    generator = np.random.default_rng(2)
    features, targets = generator.normal(size=(rows, 7)) + 3.0, generator.normal(size=(rows, 2)) - 1.0
    centred = features - features.mean(0)
    normal = centred.T @ centred / rows + penalty * np.eye(7)
    weight = np.linalg.solve(normal, centred.T @ (targets - targets.mean(0)) / rows)
    solution = Ridge(features, targets).solve(penalty)
    np.testing.assert_allclose(solution.weight, weight, rtol=1e-6, atol=1e-8)
    np.testing.assert_allclose(solution(features).mean(0), targets.mean(0), atol=1e-9)


def test_mutual_information_is_the_double_sum():
    generator = np.random.default_rng(3)
    first = generator.integers(5, size=200)
    second = (first + generator.integers(3, size=200)) % 6
    slow = 0.0
    for a in range(5):
        for b in range(6):
            joint = np.mean((first == a) & (second == b))
            if joint:
                slow += joint * math.log2(joint / (np.mean(first == a) * np.mean(second == b)))
    assert mutual_information(first, second) == pytest.approx(slow, abs=1e-12)


def test_r2_is_one_minus_residual_over_total():
    generator = np.random.default_rng(4)
    target = generator.normal(size=(30, 1))
    predicted = target + generator.normal(size=(30, 1)) * 0.5
    residual = sum((t - p) ** 2 for t, p in zip(target[:, 0], predicted[:, 0], strict=True))
    mean = sum(target[:, 0]) / 30
    assert explained(predicted, target) == pytest.approx(1 - residual / sum((t - mean) ** 2 for t in target[:, 0]))
