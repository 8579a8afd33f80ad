"""Kernel ridge regression beside (K + n p I)^-1 Y, and its fold errors beside really predicting what is held out."""

import numpy as np
import pytest

from repdib_lightning.evaluation import kernel_ridge
from repdib_lightning.evaluation.kernel_ridge import PENALTIES, WIDTHS, Kernel, fit_kernel_ridge, squared_distances
from repdib_lightning.evaluation.splits import episode_folds

ROWS, FEATURES, TARGETS = 36, 3, 5
EPISODES = np.repeat(np.arange(6), 6)


def slow_kernel(first, second, width):
    matrix = np.zeros((len(first), len(second)))
    for i, x in enumerate(first):
        for j, y in enumerate(second):
            distance = float(((x - y) ** 2).sum())
            matrix[i, j] = float((x * y).sum()) / len(x) + (0.0 if width is None else np.exp(-distance / width))
    return matrix


def slow_prediction(features, targets, new, width, penalty):
    """Ridge about the mean of the targets it is fitted on."""
    mean = targets.mean(0)
    similarity = slow_kernel(features, features, width)
    solved = np.linalg.solve(similarity + len(features) * penalty * np.eye(len(features)), targets - mean)
    return slow_kernel(new, features, width) @ solved + mean


def slow_error(features, targets, held_out, width, penalty):
    predicted = slow_prediction(features[~held_out], targets[~held_out], features[held_out], width, penalty)
    return float(((predicted - targets[held_out]) ** 2).sum())


def centred_gram(targets):
    centred = targets - targets.mean(0)
    return centred @ centred.T


@pytest.fixture(scope="module", params=["linear", "bent", "noise"])
def table(request):
    generator = np.random.default_rng(4)
    features = generator.normal(size=(ROWS, FEATURES))
    mixing = generator.normal(size=(FEATURES, TARGETS))
    shape = {"linear": features, "bent": np.sin(2.5 * features), "noise": 0.0 * features}[request.param]
    targets = shape @ mixing + 0.1 * generator.normal(size=(ROWS, TARGETS)) + 7.0
    return features, targets


@pytest.mark.parametrize("width", [None, 2.5])
def test_the_kernel_and_the_distances_are_those_of_single_rows(table, width):
    features, _ = table
    np.testing.assert_allclose(Kernel(width)(features[:7], features), slow_kernel(features[:7], features, width))
    distances = [[((x - y) ** 2).sum() for y in features] for x in features[:7]]
    np.testing.assert_allclose(squared_distances(features[:7], features), distances, atol=1e-12)


@pytest.mark.parametrize("width", [None, 2.5])
@pytest.mark.parametrize("held_out", [EPISODES == 2, EPISODES % 2 == 0, np.arange(ROWS) == 35])
def test_fold_errors_from_inner_products_are_those_of_real_predictions(table, width, held_out):
    features, targets = table
    similarity = Kernel(width)(features, features)
    found = kernel_ridge._fold_errors(similarity, centred_gram(targets), held_out)
    slow = [slow_error(features, targets, held_out, width, penalty) for penalty in PENALTIES]
    usable = np.array(PENALTIES) >= 1e-7  # below, the slow inverse itself has lost digits
    np.testing.assert_allclose(found[usable], np.array(slow)[usable], rtol=1e-8, atol=1e-8)
    np.testing.assert_allclose(found, slow, rtol=1e-5)


def test_the_choice_is_the_one_with_the_least_held_out_error_and_predicts_as_the_slow_one(table):
    features, targets = table
    folds = episode_folds(EPISODES)
    fitted = fit_kernel_ridge(features, centred_gram(targets), folds)
    apart = [((x - y) ** 2).sum() for i, x in enumerate(features) for j, y in enumerate(features) if i != j]
    widths = [None if width is None else width * float(np.median(apart)) for width in WIDTHS]
    errors = {
        (width, penalty): sum(slow_error(features, targets, held_out, width, penalty) for held_out in folds)
        for width in widths
        for penalty in PENALTIES
    }
    width, penalty = min(errors, key=errors.get)
    assert fitted.penalty == penalty and fitted.kernel.width == (None if width is None else pytest.approx(width))
    new = np.random.default_rng(9).normal(size=(8, FEATURES))
    predicted = fitted.weights(new) @ (targets - targets.mean(0)) + targets.mean(0)
    slow = slow_prediction(features, targets, new, fitted.kernel.width, penalty)
    np.testing.assert_allclose(predicted, slow, rtol=1e-8, atol=1e-8)


def test_what_bends_takes_the_gaussian_part_and_noise_the_strongest_penalty():
    generator = np.random.default_rng(5)
    features = generator.normal(size=(120, 2))
    folds = episode_folds(np.repeat(np.arange(6), 20))
    bent = fit_kernel_ridge(features, centred_gram(np.sin(3 * features)), folds)
    flat = features @ generator.normal(size=(2, 30)) + 0.1 * generator.normal(size=(120, 30))
    straight = fit_kernel_ridge(features, centred_gram(flat), folds)
    noise = fit_kernel_ridge(features, centred_gram(generator.normal(size=(120, 40))), folds)
    assert bent.kernel.width is not None
    assert bent.penalty < straight.penalty < noise.penalty
    assert noise.penalty == PENALTIES[0]


def test_latents_that_are_all_equal_predict_the_mean():
    targets = np.random.default_rng(6).normal(size=(ROWS, TARGETS))
    fitted = fit_kernel_ridge(np.zeros((ROWS, FEATURES)), centred_gram(targets), episode_folds(EPISODES))
    drawn = fitted.weights(np.zeros((4, FEATURES))) @ (targets - targets.mean(0))
    np.testing.assert_allclose(drawn, 0.0, atol=1e-7)
