"""The LightningModule: one pass a step, named losses, gradients everywhere, nothing moved by evaluation."""

from __future__ import annotations

import copy
import itertools

import lightning.pytorch as pl
import pytest
import torch

from repdib_lightning.bottlenecks import BOTTLENECKS, Identity, RepDIB, VectorQuantiser
from repdib_lightning.data.datamodule import EpisodeDataModule
from repdib_lightning.encoders import ConvolutionalEncoder
from repdib_lightning.errors import UserError
from repdib_lightning.objectives import InverseDynamics, Prototypes
from repdib_lightning.representation import RepresentationModule, distinct_frames


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


RATE = 0.25


def with_target(spec, bottleneck=lambda width: RepDIB(width, groups=4, codes=5, start_step=2), **options):
    def prototypes(width, spec):
        return Prototypes(width, spec, prototypes=6, projected=8, hidden=16, target_rate=RATE)

    torch.manual_seed(0)
    build = {"encoder": lambda spec: ConvolutionalEncoder(spec, features=16, strides=[2, 2]), "bottleneck": bottleneck}
    return RepresentationModule(**build, objective=prototypes, **options).build(spec).train()


def learn(model, data, steps, optimiser=None):
    """Steps as the trainer makes them, and their losses."""
    optimiser = optimiser or model.configure_optimizers()
    samples, losses = itertools.cycle(data.train_dataloader()), []
    for step in range(steps):
        torch.manual_seed(step)
        output = model._evaluate(next(samples))
        loss = sum(value * model._weight(name) for name, value in output.losses.items())
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        model.follow_target()
        losses.append(loss.detach())
    return losses


def test_only_an_objective_that_asks_for_a_target_has_one(data):
    plain, model = module(data.spec), with_target(data.spec)
    assert plain.target is None and not any("target" in name for name in plain.state_dict())
    plain.follow_target()
    online = {name for name in model.state_dict() if name.startswith(("encoder.", "bottleneck."))}
    assert {name.removeprefix("target.") for name in model.state_dict() if name.startswith("target.")} == online
    assert online == {name for name in module(data.spec).state_dict() if not name.startswith("objective.")}


def test_the_target_follows_at_its_rate_and_its_codes_at_once(data):
    model = with_target(data.spec)
    before = copy.deepcopy(model.target.state_dict())
    head = model.objective.target_predictor.get_buffer("weight").clone()
    learn(model, data, 1)
    online = {name: value for name, value in model.state_dict().items() if name.startswith(("encoder.", "bottleneck."))}
    weights = {name for name, _ in model.named_parameters()}
    moved = 0
    for name, value in model.target.state_dict().items():
        if name in weights:
            moved += not torch.equal(value, before[name])
            torch.testing.assert_close(value, before[name].lerp(online[name], RATE))
        elif "reservoir" not in name:
            assert torch.equal(value, online[name]), name
    assert moved > 5 and online["bottleneck.quantiser.steps"] == 1
    predictor = model.objective.predictor.weight
    torch.testing.assert_close(model.objective.target_predictor.get_buffer("weight"), head.lerp(predictor, RATE))


@pytest.mark.parametrize("codebook", ["ema", "gradient"])
def test_a_quantiser_that_starts_late_starts_in_the_target_too(data, codebook):
    model = with_target(data.spec, lambda width: RepDIB(width, groups=4, codes=5, start_step=2, codebook=codebook))
    optimiser = model.configure_optimizers()
    learn(model, data, 2, optimiser)
    assert not model.bottleneck.ready and not model.target.bottleneck.ready
    gathered = model.bottleneck.quantiser.reservoir.rows
    assert gathered.abs().sum() > 0 and model.target.bottleneck.quantiser.reservoir.rows.abs().sum() == 0
    learn(model, data, 1, optimiser)
    assert model.target.bottleneck.ready and len(model.target.bottleneck.quantiser.reservoir.rows) == 0
    assert torch.equal(model.target.bottleneck.quantiser.codebook, model.bottleneck.quantiser.codebook)
    pictures = {name: frames[:, 0] for name, frames in next(iter(data.val_dataloader())).observations.items()}
    assert model.target.bottleneck(model.target.encoder(pictures)).codes is not None
    learn(model, data, 2, optimiser)
    same = torch.equal(model.target.bottleneck.quantiser.codebook, model.bottleneck.quantiser.codebook)
    assert same == (codebook == "ema")


def test_the_target_never_trains(data):
    model = with_target(data.spec, lambda width: VectorQuantiser(width, groups=4, codes=5, start_step=0))
    learn(model, data, 2)
    assert model.training and not any(part.training for part in model.target.modules())
    assert not any(weight.requires_grad for weight in model.target.parameters())
    assert all(weight.grad is None for weight in model.target.parameters())
    given = {id(weight) for group in model.configure_optimizers().param_groups for weight in group["params"]}
    online = {id(weight) for weight in model.parameters() if weight.requires_grad}
    assert given == online and not given & {id(weight) for weight in model.target.parameters()}
    before = copy.deepcopy(model.target.state_dict())
    batch = next(iter(data.train_dataloader()))
    seen = []
    handle = model.target.register_forward_hook(lambda part, inputs, output: seen.append(output))
    for mode in (True, False):
        model.train(mode)._evaluate(batch)
    handle.remove()
    assert all(torch.equal(value, before[name]) for name, value in model.target.state_dict().items())
    assert len(seen) == 2 and not any(latents.requires_grad for latents in seen)


def test_gradients_reach_everything_but_the_target(data):
    model = with_target(data.spec, lambda width: RepDIB(width, groups=4, codes=5, start_step=0))
    losses = model._evaluate(next(iter(data.train_dataloader()))).losses
    assert set(losses) == {"prototypes", "kl", "commitment"}
    sum(losses.values()).backward()
    missing = [key for key, p in model.named_parameters() if p.requires_grad and not p.grad.abs().sum() > 0]
    assert not missing


def test_the_target_sees_pictures_shifted_by_themselves(data):
    model = with_target(data.spec, lambda width: Identity(width), shift=3)
    batch = next(iter(data.train_dataloader()))
    for frames in batch.observations.values():
        frames[:, -1] = frames[:, 0]
    seen = {"online": [], "target": []}
    model.encoder.register_forward_hook(lambda part, inputs, output: seen["online"].append(output))
    model.target.encoder.register_forward_hook(lambda part, inputs, output: seen["target"].append(output))
    model._evaluate(batch)
    model.eval()._evaluate(batch)
    assert not torch.allclose(seen["online"][0], seen["target"][0], atol=1e-3)
    torch.testing.assert_close(seen["online"][1], seen["target"][1])


def test_evaluation_with_a_target_is_deterministic_and_changes_nothing(data):
    model = with_target(data.spec)
    learn(model, data, 4)
    model.eval()
    batch, generator = next(iter(data.train_dataloader())), torch.get_rng_state()
    before = {key: value.clone() for key, value in model.state_dict().items()}
    first, second = model._evaluate(batch), model._evaluate(batch)
    assert all(torch.equal(first.losses[key], second.losses[key]) for key in first.losses)
    assert all(torch.equal(value, before[key]) for key, value in model.state_dict().items())
    assert torch.equal(generator, torch.get_rng_state())


@pytest.mark.parametrize("steps", [1, 4])
def test_a_saved_target_goes_on_exactly(data, steps):
    """Saved before its quantiser has started, and after."""
    first, second = with_target(data.spec), with_target(data.spec)
    optimisers = first.configure_optimizers(), second.configure_optimizers()
    learn(first, data, steps, optimisers[0])
    second.load_state_dict(copy.deepcopy(first.state_dict()))
    optimisers[1].load_state_dict(copy.deepcopy(optimisers[0].state_dict()))
    assert second.target.bottleneck.ready == (steps == 4)
    losses = [learn(model, data, 4, optimiser) for model, optimiser in zip((first, second), optimisers, strict=True)]
    assert all(torch.equal(*pair) for pair in zip(*losses, strict=True))
    assert all(torch.equal(value, second.state_dict()[name]) for name, value in first.state_dict().items())


@pytest.mark.parametrize("accumulated", [1, 2])
def test_the_trainer_lets_the_target_follow_after_each_optimiser_step(data, accumulated):
    class Counting(RepresentationModule):
        followed = 0

        def follow_target(self):
            self.followed += 1
            super().follow_target()

    model = Counting(
        lambda spec: ConvolutionalEncoder(spec, features=16, strides=[2, 2]),
        Identity,
        lambda width, spec: Prototypes(width, spec, prototypes=6, projected=8, hidden=16),
    )
    quiet = {"logger": False, "enable_progress_bar": False, "enable_model_summary": False, "accelerator": "cpu"}
    silent = {"enable_checkpointing": False, "num_sanity_val_steps": 0, "limit_val_batches": 0}
    trainer = pl.Trainer(max_steps=3, accumulate_grad_batches=accumulated, **quiet, **silent)
    trainer.fit(model, datamodule=data)
    assert trainer.global_step == 3 and model.followed == 3


def test_a_target_stays_precise_in_half_precision(data):
    model = with_target(data.spec, lambda width: Identity(width))
    model.to(torch.bfloat16)
    before = model.target.encoder.trunk[0].weight.clone()
    assert before.dtype == torch.float32 and model.encoder.trunk[0].weight.dtype == torch.bfloat16
    torch.set_default_dtype(torch.bfloat16)
    try:
        losses = model._evaluate(next(iter(data.train_dataloader()))).losses
    finally:
        torch.set_default_dtype(torch.float32)
    assert losses["prototypes"].isfinite()
    with torch.no_grad():
        model.encoder.trunk[0].weight.add_(2**-6)
    model.target.rate = 0.001
    model.follow_target()
    moved = model.target.encoder.trunk[0].weight - before
    wanted = 0.001 * (model.encoder.trunk[0].weight.float() - before)
    torch.testing.assert_close(moved, wanted, rtol=1e-2, atol=1e-7)


def test_a_frame_of_several_samples_is_encoded_once(store_file):
    data = EpisodeDataModule(str(store_file), batch_size=12, horizon=2, futures=6)
    data.setup()
    batch = next(iter(data.train_dataloader()))
    rows = (batch.rows[:, None] + batch.offsets).flatten()
    passes, results = {}, {}
    for once in (False, True):
        model = module(data.spec, lambda width: Identity(width), shift=0, encode_once=once)
        passes[once] = []
        model.encoder.register_forward_hook(lambda *hooked, seen=passes[once]: seen.append(len(hooked[2])))
        loss = model._evaluate(batch).losses["inverse"]
        loss.backward()
        results[once] = loss, torch.cat([p.grad.flatten() for p in model.parameters()])
    assert passes == {False: [len(rows)], True: [len(set(rows.tolist()))]} and passes[True] < passes[False]
    torch.testing.assert_close(results[True][0], results[False][0])
    torch.testing.assert_close(results[True][1], results[False][1], rtol=1e-4, atol=1e-6)


def test_distinct_frames_are_where_they_are_first_met(data):
    batch = next(iter(data.train_dataloader()))
    rows = (batch.rows[:, None] + batch.offsets).flatten()
    first, place = distinct_frames(batch)
    assert torch.equal(rows[first][place], rows)
    assert first.tolist() == sorted((rows.tolist().index(row) for row in set(rows.tolist())), key=lambda i: rows[i])


def test_copies_that_a_shift_makes_differ_are_not_one_frame(data):
    with pytest.raises(UserError, match=r"encode_once.*model\.shift, which is 4; set it to 0"):
        module(data.spec, encode_once=True)
