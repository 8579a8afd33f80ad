"""The LightningModule: one pass a step, named losses, gradients everywhere, nothing moved by evaluation."""

from __future__ import annotations

import pytest
import torch

from repdib_lightning.bottlenecks import BOTTLENECKS, Identity, RepDIB
from repdib_lightning.data.datamodule import EpisodeDataModule
from repdib_lightning.encoders import ConvolutionalEncoder
from repdib_lightning.errors import UserError
from repdib_lightning.objectives import InverseDynamics
from repdib_lightning.representation import RepresentationModule


@pytest.fixture
def data(store_file):
    data = EpisodeDataModule(str(store_file), batch_size=6, horizon=2, futures=2)
    data.setup()
    return data


def module(spec, bottleneck=lambda width: RepDIB(width, groups=4, codes=5, start_step=0), **options):
    torch.manual_seed(0)
    built = RepresentationModule(
        lambda spec: ConvolutionalEncoder(spec, features=16, strides=[2, 2]), bottleneck, InverseDynamics, **options
    )
    return built.build(spec)


@pytest.mark.parametrize("name", BOTTLENECKS)
def test_a_step_reaches_every_parameter_with_one_pass(data, name):
    options = {"start_step": 0, "groups": 4, "codes": 5} if name in ("VectorQuantiser", "RepDIB") else {}
    model = module(data.spec, lambda width: BOTTLENECKS[name](width, **options))
    passes = []
    model.encoder.register_forward_hook(lambda encoder, inputs, output: passes.append(output.shape))
    batch = next(iter(data.train_dataloader()))
    output = model._evaluate(batch)
    sum(output.losses.values()).backward()
    assert passes == [(6 * 3, 16)]
    missing = [key for key, p in model.named_parameters() if p.grad is None or not p.grad.abs().sum() > 0]
    assert not missing


def test_the_loss_is_the_weighted_sum_of_the_terms(data):
    model = module(data.spec, loss_weights={"inverse": 2.0, "kl": 0.5}, shift=0).train()
    model.log = lambda *_, **__: None
    batch = next(iter(data.train_dataloader()))
    result = model.training_step(batch, 0)
    terms = result["terms"]
    assert set(terms) == {"inverse", "kl", "commitment"}
    wanted = 2.0 * terms["inverse"] + 0.5 * terms["kl"] + 0.25 * terms["commitment"]
    torch.testing.assert_close(result["loss"].detach(), wanted)


def test_warmup_rises_linearly(data, monkeypatch):
    model = module(data.spec, warmup={"kl": 4})
    for step, share in ((0, 0.25), (1, 0.5), (3, 1.0), (9, 1.0)):
        monkeypatch.setattr(type(model), "global_step", step)
        assert model._weight("kl") == pytest.approx(0.01 * share)
        assert model._weight("inverse") == 1.0


def test_evaluation_is_deterministic_and_changes_no_buffer(data):
    model = module(data.spec)
    batch = next(iter(data.train_dataloader()))
    model.train()._evaluate(batch)
    model.eval()
    before = {key: value.clone() for key, value in model.state_dict().items()}
    first, second = model._evaluate(batch), model._evaluate(batch)
    assert all(torch.equal(first.losses[key], second.losses[key]) for key in first.losses)
    assert all(torch.equal(value, before[key]) for key, value in model.state_dict().items())


def test_pictures_are_shifted_in_training_only(data):
    model = module(data.spec, lambda width: Identity(width), shift=3)
    batch = next(iter(data.train_dataloader()))
    still = [model.eval()._evaluate(batch).losses["inverse"] for _ in range(2)]
    moving = [model.train()._evaluate(batch).losses["inverse"] for _ in range(2)]
    assert torch.equal(*still) and not torch.equal(*moving)


def test_a_rehearsal_changes_nothing_and_finds_unknown_losses(data):
    model = module(data.spec).train()
    before, generator = model.state_dict(), torch.get_rng_state()
    before = {key: value.clone() for key, value in before.items()}
    model.rehearse(data.example())
    assert model.training and torch.equal(generator, torch.get_rng_state())
    assert all(torch.equal(value, before[key]) for key, value in model.state_dict().items())
    with pytest.raises(UserError, match=r"no loss is called 'comitment'.*did you mean 'commitment'"):
        module(data.spec, loss_weights={"comitment": 1.0}).rehearse(data.example())


def test_it_learns_the_cell(make_store, tmp_path):
    """The action is the step from cell to cell: the loss must fall well below that of a guess (log 4)."""
    path = make_store(tmp_path / "learn.h5", lengths=(120, 120, 30, 30))
    data = EpisodeDataModule(str(path), batch_size=32, horizon=1, views=["front"])
    data.setup()
    model = module(data.spec, lambda width: RepDIB(width, groups=4, codes=8, start_step=40), shift=0).train()
    optimiser = torch.optim.Adam(model.parameters(), 3e-3)
    loader, losses = data.train_dataloader(), []
    while len(losses) < 160:
        for batch in loader:
            output = model._evaluate(batch)
            loss = sum(value * model._weight(name) for name, value in output.losses.items())
            optimiser.zero_grad()
            loss.backward()
            optimiser.step()
            losses.append(output.losses["inverse"].item())
    assert sum(losses[-10:]) / 10 < 0.5 * torch.tensor(4.0).log()
    model.eval()
    held_out = [model._evaluate(batch).metrics["action_accuracy"] for batch in data.val_dataloader()]
    assert torch.stack(held_out).mean() > 0.8
