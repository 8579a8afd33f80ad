"""The estimators: right on Gaussians, zero without dependence, and strangers that are strangers."""

from __future__ import annotations

import math

import pytest
import torch

from repdib_lightning.bottlenecks.mutual_information import (
    StatisticsNetwork,
    donsker_varadhan,
    jensen_shannon_loss,
    mismatched,
)

D, BATCH = 2, 512


def gaussians(correlation, count):
    x, noise = torch.randn(2, count, D)
    return x, correlation * x + math.sqrt(1 - correlation**2) * noise


def scores(network, x, y, training=True):
    return network(x, y), network(x, mismatched(y, training=training))


def trained(correlation, loss_of, steps=400):
    torch.manual_seed(0)
    network = StatisticsNetwork(2 * D, 64, bias=True)
    optimiser = torch.optim.Adam(network.parameters(), 3e-3)
    for _ in range(steps):
        loss = loss_of(*scores(network, *gaussians(correlation, BATCH)))
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
    return network


def negative_bound(pairs, strangers):
    return -donsker_varadhan(pairs, strangers, equal=True)


@pytest.mark.parametrize("correlation", [0.5, 0.8])
def test_the_trained_bound_comes_close_to_the_information_of_gaussians(correlation):
    network = trained(correlation, negative_bound)
    truth = -0.5 * D * math.log(1 - correlation**2)
    with torch.no_grad():
        bound = donsker_varadhan(*scores(network, *gaussians(correlation, 50_000)), equal=True)
    assert bound.item() == pytest.approx(truth, rel=0.15)


def test_without_dependence_the_bound_is_about_zero_and_the_loss_at_chance():
    by_bound, by_loss = trained(0.0, negative_bound), trained(0.0, jensen_shannon_loss)
    fresh = gaussians(0.0, 50_000)
    with torch.no_grad():
        assert abs(donsker_varadhan(*scores(by_bound, *fresh), equal=True)) < 0.03
        loss = jensen_shannon_loss(*scores(by_loss, *fresh))
    assert loss.item() == pytest.approx(2 * math.log(2), abs=0.02)


def test_the_bound_does_not_depend_on_a_constant_and_survives_large_scores():
    pairs, strangers = torch.randn(2, 40, dtype=torch.float64)
    bound = donsker_varadhan(pairs, strangers, equal=True)
    torch.testing.assert_close(bound, pairs.mean() - strangers.exp().mean().log())
    torch.testing.assert_close(donsker_varadhan(pairs + 1e4, strangers + 1e4, equal=True), bound)


def test_the_jensen_shannon_loss_pulls_variables_together():
    """Both players descend it: a variable that can choose its dependence on another becomes that other."""
    torch.manual_seed(0)
    network, angle = StatisticsNetwork(2 * D, 64, bias=True), torch.tensor(0.3, requires_grad=True)
    optimiser = torch.optim.Adam([{"params": network.parameters()}, {"params": [angle], "lr": 1e-2}], 3e-3)
    for _ in range(200):
        x, noise = torch.randn(2, BATCH, D)
        loss = jensen_shannon_loss(*scores(network, x, angle.sin() * x + angle.cos() * noise))
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
    assert angle.sin() > 0.9 and loss < 1.0


@pytest.mark.parametrize("training", [True, False])
@pytest.mark.parametrize("count", [2, 3, 7, 64])
def test_strangers_are_all_rows_and_nobody_is_his_own(training, count):
    rows = torch.arange(count)
    for seed in range(20):
        torch.manual_seed(seed)
        partners = mismatched(rows, training=training)
        assert sorted(partners.tolist()) == rows.tolist() and not (partners == rows).any()


def test_training_draws_other_strangers_each_time_and_evaluation_draws_nothing():
    rows = torch.arange(64)
    assert not torch.equal(mismatched(rows, training=True), mismatched(rows, training=True))
    before = torch.get_rng_state()
    assert torch.equal(mismatched(rows, training=False), mismatched(rows, training=False))
    assert torch.equal(torch.get_rng_state(), before)


def test_a_lone_row_and_no_row():
    assert mismatched(torch.ones(1, 3), training=True).tolist() == [[1.0, 1.0, 1.0]]
    assert mismatched(torch.ones(0, 3), training=False).shape == (0, 3)
