"""The variational bottleneck beside torch.distributions."""

import pytest
import torch
from torch.distributions import Normal, kl_divergence

from repdib_lightning.bottlenecks import Variational
from repdib_lightning.bottlenecks.variational import bounded, standard_normal_kl, unbounded


def test_kl_equals_that_of_torch_distributions():
    torch.manual_seed(0)
    mean, log_variance = torch.randn(2, 50, 7, dtype=torch.float64)
    expected = kl_divergence(Normal(mean, (log_variance / 2).exp()), Normal(0.0, 1.0))
    torch.testing.assert_close(standard_normal_kl(mean, log_variance), expected)


@pytest.mark.parametrize("reduction", ["mean", "sum"])
def test_loss_is_the_kl_of_the_distribution_that_is_sampled(reduction):
    torch.manual_seed(0)
    bottleneck = Variational(6, kl_reduction=reduction).double()
    torch.nn.init.normal_(bottleneck.head.layer.weight, std=0.5)
    latent = torch.randn(40, 6, dtype=torch.float64)
    mean, raw = bottleneck.head(latent)
    sigma = (bounded(raw, bottleneck.low, bottleneck.high) / 2).exp()
    divergence = kl_divergence(Normal(mean, sigma), Normal(0.0, 1.0))
    expected = divergence.mean() if reduction == "mean" else divergence.sum(-1).mean()
    torch.testing.assert_close(bottleneck(latent).losses["kl"], expected)


def test_bound_is_the_identity_inside_and_has_an_exact_inverse():
    inside = torch.linspace(-6.0, -2.0, 9, dtype=torch.float64)
    torch.testing.assert_close(bounded(inside, -10.0, 2.0), inside, atol=0.02, rtol=0.0)
    for value in (-9.99, -4.0, 1.9):
        raw = torch.tensor(unbounded(value, -10.0, 2.0), dtype=torch.float64)
        assert bounded(raw, -10.0, 2.0).item() == pytest.approx(value, abs=1e-9)
