import pytest
import torch

from repdib_lightning.bottlenecks import Variational
from repdib_lightning.bottlenecks.variational import bounded
from repdib_lightning.errors import UserError


@pytest.mark.parametrize("head", ["linear", "split"])
def test_log_variance_starts_exactly_whatever_the_input(head):
    bottleneck = Variational(8, head=head, log_variance_start=-3.0)
    _, raw = bottleneck.head(100 * torch.randn(20, 8))
    log_variance = bounded(raw, bottleneck.low, bottleneck.high)
    torch.testing.assert_close(log_variance, torch.full_like(log_variance, -3.0), atol=1e-5, rtol=0.0)


def test_evaluation_before_training_is_the_identity():
    latent = torch.randn(20, 8)
    assert torch.equal(Variational(8).eval()(latent).latent, latent)


def test_samples_have_the_mean_and_the_deviation():
    torch.manual_seed(0)
    bottleneck = Variational(4, log_variance_start=-1.0)
    latent = torch.tensor([[3.0, -1.0, 0.0, 0.5]]).expand(40_000, 4)
    sample = bottleneck(latent).latent
    torch.testing.assert_close(sample.mean(0), latent[0], atol=0.02, rtol=0.0)
    torch.testing.assert_close(sample.std(0), torch.full((4,), 0.6065), atol=0.01, rtol=0.0)


def test_training_draws_anew_and_evaluation_does_not():
    bottleneck = Variational(8)
    latent = torch.randn(5, 8)
    assert not torch.equal(bottleneck(latent).latent, bottleneck(latent).latent)
    bottleneck.eval()
    random_state = torch.get_rng_state()
    assert torch.equal(bottleneck(latent).latent, bottleneck(latent).latent)
    assert torch.equal(torch.get_rng_state(), random_state)


def test_kl_is_zero_at_the_prior_only():
    bottleneck = Variational(8, log_variance_start=0.0)
    assert bottleneck(torch.zeros(5, 8)).losses["kl"].item() == pytest.approx(0.0, abs=1e-5)
    assert bottleneck(torch.ones(5, 8)).losses["kl"].item() == pytest.approx(0.5, abs=1e-5)


def test_sum_is_width_times_mean():
    latent = torch.randn(5, 8)
    mean = Variational(8, kl_reduction="mean")(latent).losses["kl"]
    total = Variational(8, kl_reduction="sum")(latent).losses["kl"]
    torch.testing.assert_close(total, 8 * mean)


@pytest.mark.parametrize("overshoot", [0.0, 5.0, 40.0])
def test_gradient_survives_at_and_beyond_the_bounds(overshoot):
    raw = torch.tensor([-10.0 - overshoot, 2.0 + overshoot], requires_grad=True)
    log_variance = bounded(raw, -10.0, 2.0)
    log_variance.sum().backward()
    assert (raw.grad > 0).all()
    assert log_variance.min() >= -10.0
    assert log_variance.max() <= 2.0 + 1e-4


def test_huge_inputs_stay_finite():
    bottleneck = Variational(8)
    torch.nn.init.normal_(bottleneck.head.layer.weight)
    latent = torch.full((3, 8), 1e4, requires_grad=True)
    output = bottleneck(latent)
    (output.latent.sum() + output.losses["kl"]).backward()
    assert torch.isfinite(output.latent).all()
    assert torch.isfinite(latent.grad).all()


@pytest.mark.parametrize("head", ["linear", "split"])
def test_gradients_reach_every_parameter(head):
    bottleneck = Variational(8, head=head)
    output = bottleneck(torch.randn(16, 8))
    (output.latent.square().mean() + output.losses["kl"]).backward()
    for name, parameter in bottleneck.named_parameters():
        assert parameter.grad.abs().sum() > 0, name


@pytest.mark.parametrize("head", ["linear", "split"])
def test_autocast_and_half_precision(head):
    bottleneck = Variational(8, head=head).eval()
    latent = torch.randn(5, 8)
    plain = bottleneck(latent)
    with torch.autocast("cpu", dtype=torch.bfloat16):
        cast = bottleneck(latent)
        assert bottleneck(latent.bfloat16()).latent.dtype == torch.bfloat16
    assert torch.equal(cast.latent, plain.latent)
    assert cast.losses["kl"].dtype == torch.float32
    halved = bottleneck.to(torch.bfloat16)(latent.bfloat16())
    assert halved.latent.dtype == torch.bfloat16
    torch.testing.assert_close(halved.latent.float(), plain.latent, atol=0.03, rtol=0.03)


def test_metrics_are_detached_and_say_the_scales():
    metrics = Variational(8, log_variance_start=-4.0)(torch.full((5, 8), 2.0, requires_grad=True)).metrics
    assert not any(value.requires_grad for value in metrics.values())
    assert metrics["sigma"].item() == pytest.approx(0.1353, abs=1e-3)
    assert metrics["mean_rms"].item() == pytest.approx(2.0)
    assert metrics["kl_nats"].item() == pytest.approx(8 * 0.5 * (4 + 0.0183 - 1 + 4), abs=1e-2)


@pytest.mark.parametrize(
    ("width", "options", "message"),
    [
        (8, {"head": "liner"}, "did you mean 'linear'"),
        (8, {"kl_reduction": "total"}, "choices: mean, sum"),
        (8, {"log_variance_start": 3.0}, "log_variance_start 3.0 must lie between"),
        (8, {"log_variance_start": -10.0}, "log_variance_low -10.0"),
        (7, {"head": "split"}, "nearest: 6, 8"),
        (0, {}, "width must be at least 1"),
    ],
)
def test_mistakes_are_named(width, options, message):
    with pytest.raises(UserError, match=message):
        Variational(width, **options)


def test_wrong_width_is_named():
    with pytest.raises(UserError, match=r"takes \(N, 8\), was given \(5, 9\)"):
        Variational(8)(torch.zeros(5, 9))
