"""SVIB: who moves by which loss, what the penalty does, and that evaluation and bundles are those of a bottleneck."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from repdib_lightning.bottlenecks import SVIB, Variational
from repdib_lightning.encoders import ConvolutionalEncoder
from repdib_lightning.errors import UserError
from repdib_lightning.export import load_encoder, save_bundle
from repdib_lightning.export.formats import example_batch
from repdib_lightning.loss_weights import DEFAULT_LOSS_WEIGHTS
from repdib_lightning.records import ArraySpec, DataSpec

M = 6


def built(**options):
    torch.manual_seed(0)
    return SVIB(M, **{"hidden": 32, **options})


def latents(count=64, seed=1):
    return torch.randn(count, M, generator=torch.Generator().manual_seed(seed))


def gradients(bottleneck, name, latent):
    bottleneck.zero_grad()
    bottleneck(latent).losses[name].backward()
    return {key: parameter.grad for key, parameter in bottleneck.named_parameters()}


def test_the_network_moves_by_the_estimator_alone_and_everything_else_by_the_information_alone():
    bottleneck, latent = built(), latents().requires_grad_()
    for name, mover in (("information", "gaussian."), ("estimator", "statistics.")):
        latent.grad = None
        for key, gradient in gradients(bottleneck, name, latent).items():
            assert (gradient is not None and gradient.abs().sum() > 0) == key.startswith(mover), (name, key)
        assert (latent.grad is not None) == (name == "information")


def test_the_two_losses_are_one_estimate_with_opposite_signs():
    output = built()(latents())
    torch.testing.assert_close(output.losses["information"], -output.losses["estimator"])
    assert DEFAULT_LOSS_WEIGHTS["information"] == 1e-4 and "estimator" not in DEFAULT_LOSS_WEIGHTS


def train(bottleneck, weights, steps=300):
    """Descend the weighted losses on fresh latents; return the mean estimate and deviation of the last steps."""
    optimiser = torch.optim.Adam(bottleneck.parameters(), 3e-3)
    generator, last = torch.Generator().manual_seed(2), []
    for step in range(steps):
        output = bottleneck(torch.randn(256, M, generator=generator))
        loss = sum(weight * output.losses[name] for name, weight in weights.items())
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        if step >= steps - 20:
            last.append(torch.stack([output.losses["information"].detach(), output.metrics["sigma"]]))
    return torch.stack(last).mean(0)


def test_the_network_ascends_the_estimate():
    estimate, sigma = train(built(), {"estimator": 1.0})
    assert estimate > 1.5
    assert sigma.item() == pytest.approx(0.1353, abs=1e-3)


def test_the_penalty_takes_information_away():
    """The game of both: noise rises and means shrink until little is left to be estimated."""
    free, _ = train(built(), {"estimator": 1.0})
    squeezed, sigma = train(built(), {"estimator": 1.0, "information": 1.0})
    assert squeezed < 0.5 * free and sigma > 0.2


def test_evaluation_gives_the_mean_draws_nothing_and_changes_no_buffer():
    bottleneck = built().eval()
    before, random_state = {key: value.clone() for key, value in bottleneck.state_dict().items()}, torch.get_rng_state()
    latent = latents()
    first, second = bottleneck(latent), bottleneck(latent)
    assert torch.equal(first.latent, latent) and torch.equal(second.latent, latent)
    assert torch.equal(first.losses["information"], second.losses["information"])
    assert torch.equal(torch.get_rng_state(), random_state)
    assert all(torch.equal(value, before[key]) for key, value in bottleneck.state_dict().items())


def test_training_is_that_of_the_generator():
    torch.manual_seed(5)
    first = built().train()(latents())
    second = built().train()(latents())
    assert torch.equal(first.latent, second.latent)
    assert torch.equal(first.losses["information"], second.losses["information"])


def test_the_sample_is_that_of_the_variational_bottleneck():
    bottleneck, plain = (
        built(log_variance_start=-2.0, head="split"),
        Variational(M, log_variance_start=-2.0, head="split"),
    )
    plain.load_state_dict(bottleneck.gaussian.state_dict())
    torch.manual_seed(3)
    expected = plain(latents())
    torch.manual_seed(3)
    output = bottleneck(latents())
    assert torch.equal(output.latent, expected.latent)
    assert {name: value.item() for name, value in output.metrics.items()} == {
        name: value.item() for name, value in expected.metrics.items()
    }
    assert set(output.losses) == {"information", "estimator"}


def test_autocast_and_half_precision():
    bottleneck = built().eval()
    plain = bottleneck(latents())
    with torch.autocast("cpu", dtype=torch.bfloat16):
        cast = bottleneck(latents())
    assert torch.equal(cast.losses["information"], plain.losses["information"])
    halved = bottleneck.to(torch.bfloat16)(latents().bfloat16())
    assert halved.latent.dtype == torch.bfloat16 and halved.losses["information"].dtype == torch.float32


def test_bad_options():
    with pytest.raises(UserError, match="SVIB: hidden must be at least 1, is 0"):
        SVIB(M, hidden=0)
    with pytest.raises(UserError, match="unknown head 'liner', did you mean 'linear'"):
        SVIB(M, head="liner")
    with pytest.raises(UserError, match=rf"takes \(N, {M}\), was given \(3, 5\)"):
        SVIB(M)(torch.zeros(3, 5))


def test_bundle_and_program_give_the_same_latents(tmp_path: Path):
    spec = DataSpec({"front": ArraySpec((3, 12, 12))})
    encoder, bottleneck = ConvolutionalEncoder(spec, features=M, channels=2, strides=[2]), built()
    train(bottleneck, {"estimator": 1.0, "information": 0.1}, steps=5)
    folder = save_bundle(tmp_path / "b", encoder, bottleneck, training={}, data={}, formats=["pt2"])
    frozen, program = load_encoder(folder), torch.export.load(folder / "model.pt2").module()
    for size in (1, 2, 33):
        observations = example_batch(spec, size, seed=size)
        with torch.no_grad():
            expected = bottleneck.eval()(encoder.eval()(observations)).latent
        assert torch.equal(frozen.encode(observations), expected)
        torch.testing.assert_close(program(observations)[0], expected, rtol=0, atol=1e-5)
