"""The probes beside small, slow, obviously right versions of themselves."""

import math

import numpy as np
import pytest
import torch
from scipy.optimize import minimize

from repdib_lightning.evaluation.codes import mutual_information
from repdib_lightning.evaluation.linear import Ridge, fit_logistic
from repdib_lightning.evaluation.mlp import Fold, Task, build_mlp, fit_correction
from repdib_lightning.evaluation.probes import Half, explained, measure
from repdib_lightning.evaluation.splits import episode_folds


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


def test_before_the_first_epoch_the_mlp_is_exactly_the_linear_probe(table):
    features, labels = table
    network = build_mlp(2, 3, torch.Generator().manual_seed(0))
    assert torch.count_nonzero(network(torch.from_numpy(features).float())) == 0
    base = fit_logistic(features, labels, 3, 1e-2)
    errors = []

    def grows(predicted):
        errors.append(predicted)
        return float(len(errors))

    task = Task(features, labels, base)
    fitted = fit_correction(task, [Fold(task, features, grows)], seed=0)
    assert fitted.epochs == 0
    np.testing.assert_array_equal(fitted(features), base(features))
    np.testing.assert_array_equal(errors[0], base(features))
    assert np.abs(errors[1] - base(features)).max() > 0


@pytest.mark.parametrize("classes", [True, False])
def test_the_linear_start_of_a_fold_is_fitted_without_its_episodes(classes):
    generator = np.random.default_rng(5)
    features, episodes = generator.normal(size=(120, 3)), np.repeat(np.arange(6), 20)
    values = features @ generator.normal(size=(3, 2)) + generator.normal(size=(120, 2))
    # Class 9 occurs in the first fold alone, so that fold's start has to do without it.
    target = np.where(episodes == 0, 9, (values[:, 0] > 0) * 4) if classes else values
    linear = Half(features, target, episodes).linear
    for rows, start in zip(episode_folds(episodes), linear.without, strict=True):
        if not classes:
            expected = Ridge(features[~rows], linear.target[~rows]).solve(linear.penalty)(features)
            np.testing.assert_allclose(start(features), expected, atol=1e-10)
            continue
        present, index = np.unique(target[~rows], return_inverse=True)
        expected = fit_logistic(features[~rows], index, len(present), linear.penalty)(features)
        columns = np.searchsorted([0, 4, 9], present)
        np.testing.assert_allclose(start(features)[:, columns], expected, atol=1e-2)
        assert set(start(features).argmax(1)) <= set(columns)


def test_where_no_epoch_helps_both_probes_score_alike():
    generator = np.random.default_rng(6)
    features, episodes = generator.normal(size=(160, 4)), np.repeat(np.arange(8), 20)
    target = features @ generator.normal(size=(4, 1))
    even = episodes % 2 == 0
    fit, score = (Half(features[part], target[part], episodes[part]) for part in (even, ~even))
    linear, mlp = (measure(probe, fit, score, 0) for probe in ("linear", "mlp"))
    assert mlp.choice == {"penalty": linear.choice["penalty"], "epochs": 0}
    assert mlp.score == linear.score
