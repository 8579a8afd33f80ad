"""Batches against single rows; padding, parts and the update of the module against slow ones."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
import torch.nn.functional as F
from small_choices import ACTIONS, FEATURES, FRESH, VIEW, choices_bundle, network, options, random_store

from repdib_lightning.data.episodes import EpisodeStore
from repdib_lightning.data.sampling import gather_stacks
from repdib_lightning.evaluation.encoded_store import CODES, LATENT
from repdib_lightning.export.load import load_encoder
from repdib_lightning.rl.decision_transformer import module as of_module
from repdib_lightning.rl.decision_transformer.batches import (
    IGNORED,
    PictureFrames,
    VectorTable,
    WindowBatches,
    stacked_frames,
)
from repdib_lightning.rl.decision_transformer.module import DecisionTransformerModule, schedule
from repdib_lightning.rl.decision_transformer.training import DTTraining
from repdib_lightning.rl.decision_transformer.windows import WindowOrder, Windows

CPU = torch.device("cpu")


class Fixed:
    """Random vectors for all rows."""

    def __init__(self, rows):
        self.vectors = torch.randn(rows, FEATURES, generator=torch.Generator().manual_seed(1))

    def gather(self, windows, rows):
        return self.vectors[rows]


@pytest.fixture(scope="module")
def store(tmp_path_factory):
    return EpisodeStore(random_store(tmp_path_factory.mktemp("batches") / "d.h5"))


def batches(store, context=5, batch_size=6, epochs=2, stride=1):
    windows = Windows(store, context, stride)
    return WindowBatches(windows, Fixed(store.rows), WindowOrder(len(windows), batch_size, None, 0), epochs, CPU)


def module(net=None, encoder=None, **changes):
    given = {"learning_rate": 1e-3, "weight_decay": 0.1, "warmup_tokens": 0, "tokens": 1000, **changes}
    return DecisionTransformerModule(net or network(), encoder, **given)


def updating(made):
    """The module with its optimiser, as a trainer would hand it out."""
    optimizer = made.configure_optimizers()
    made.optimizers = lambda use_pl_optimizer: optimizer
    return made, optimizer


def test_a_batch_holds_its_windows(store):
    made, actions = batches(store), store.array("actions")
    for number in range(made.total):
        batch, chosen = made.batch(number), made.order.batch(number)
        assert len(batch) == len(chosen) and batch.steps == int(made.windows.lengths[chosen].sum())
        for place, window in enumerate(chosen):
            start, steps = made.windows.starts[window], made.windows.lengths[window]
            rows = np.arange(start, start + steps)
            assert batch.actions[place, :steps].tolist() == actions[rows].tolist()
            assert batch.targets[place].tolist() == actions[rows].tolist() + [IGNORED] * (5 - steps)
            assert torch.equal(batch.returns[place, :steps], torch.from_numpy(made.windows.returns[rows]))
            assert torch.equal(batch.seen[place, :steps], made.source.vectors[rows])
            assert batch.first[place] == made.windows.timesteps[window]
            assert batch.actions[place].min() >= 0 and batch.actions[place].max() < ACTIONS


def test_they_can_be_had_from_any_on(store):
    made, later = batches(store), batches(store)
    later.first = 3
    assert len(made) == made.total and len(later) == made.total - 3
    for one, other in zip(list(made)[3:], later, strict=True):
        assert torch.equal(one.actions, other.actions) and torch.equal(one.seen, other.seen)
    lengths = made.windows.lengths
    assert 2 * made.tokens == pytest.approx(2 * lengths.sum()) == sum(batch.steps for batch in made)


@pytest.mark.parametrize("stack", [1, 3])
def test_pictures_are_stacked_as_single_rows_are(store, stack):
    windows = Windows(store, 5, 2)
    chosen = np.arange(len(windows))[::-1].copy()
    rows = torch.from_numpy(windows.rows(chosen))
    frames = PictureFrames(store, windows, [VIEW], stack, CPU).gather(chosen, rows)[VIEW]
    assert frames.dtype == torch.uint8 and frames.shape[:2] == (len(windows), stack - 1 + 5)
    found = stacked_frames(frames, stack).unflatten(0, (len(windows), 5)).numpy()
    for place, window in enumerate(chosen):
        steps = windows.lengths[window]
        np.testing.assert_array_equal(
            found[place, :steps], gather_stacks(store, VIEW, rows[place, :steps].numpy(), stack)
        )


@pytest.mark.parametrize("codes", [False, True])
def test_vectors_are_what_the_frozen_encoder_gives(tmp_path, codes):
    data = random_store(tmp_path / "d.h5")
    bundle = choices_bundle(tmp_path / "b", stack=2, quantised=True)
    training = DTTraining(options(data, encoder=bundle, codes=codes))
    training._build(tmp_path)
    batch, chosen = training.batches.batch(0), training.batches.order.batch(0)
    rows, frozen = training.batches.windows.rows(chosen), load_encoder(bundle)
    stacks = gather_stacks(training.store, VIEW, rows.reshape(-1), 2)
    wanted = frozen.codes(stacks) if codes else frozen.encode(stacks)
    assert batch.seen.dtype == wanted.dtype and wanted.float().std() > 0
    torch.testing.assert_close(batch.seen.flatten(0, 1), wanted)
    encoded = EpisodeStore(tmp_path / "latents.h5")
    whole = VectorTable(encoded, CODES if codes else LATENT, whole=codes, device=CPU).vectors
    assert whole.shape[0] == encoded.rows == training.store.rows
    if not codes:
        trained = whole[np.flatnonzero(training.batches.windows.trained)]
        standardised = training.module.network.states.standardise(trained)
        varying = trained.std(0) > 0
        torch.testing.assert_close(standardised.mean(0), torch.zeros(FEATURES), atol=1e-4, rtol=0)
        torch.testing.assert_close(standardised.std(0, correction=0)[varying], torch.ones(int(varying.sum())))


def test_the_loss_is_the_mean_over_steps_that_are_no_padding(store):
    made = module(network(context=8))
    batch = batches(store, context=8, batch_size=30).batch(0)
    assert 0 < batch.steps < batch.actions.numel()
    loss, right = made.evaluate(batch)
    total, hits = 0.0, 0
    for place in range(len(batch)):
        steps = int((batch.targets[place] != IGNORED).sum())
        part = (batch.seen[place : place + 1, :steps], batch.returns[place : place + 1, :steps])
        actions = batch.actions[place : place + 1, :steps]
        logits = made.network(*part, actions, batch.first[place : place + 1])[0]
        total += F.cross_entropy(logits, actions[0], reduction="sum").item()
        hits += int((logits.argmax(-1) == actions[0]).sum())
    assert loss.item() == pytest.approx(total, rel=1e-5) and int(right) == hits


def test_padding_changes_nothing(store):
    batch, made = batches(store, context=8, batch_size=30).batch(0), module(network(context=8))
    padding = batch.targets == IGNORED
    assert padding.any()
    grown = batch.part(slice(None))
    grown.seen = torch.where(padding.unsqueeze(-1), 9.0, batch.seen)
    grown.returns = torch.where(padding, -7.0, batch.returns)
    grown.actions = torch.where(padding, (batch.actions + 1) % ACTIONS, batch.actions)
    found = []
    for given in (batch, grown):
        made.zero_grad()
        loss, right = made.evaluate(given)
        loss.backward()
        found.append([loss.detach(), right, *(weight.grad.clone() for weight in made.parameters())])
    assert all(torch.equal(one, other) for one, other in zip(*found, strict=True))


@pytest.mark.parametrize("end_to_end", [False, True])
def test_an_update_in_parts_is_an_update(tmp_path, monkeypatch, end_to_end):
    data = random_store(tmp_path / "d.h5")
    bundle = choices_bundle(tmp_path / "b")
    chosen = FRESH if end_to_end else {"encoder": bundle}
    after = []
    for budget in (1, 3 * 4, 1 << 30):  # a window, three, all
        monkeypatch.setattr(of_module, "_STEPS", {"cpu": budget})
        folder = tmp_path / str(budget)
        folder.mkdir()
        training = DTTraining(options(data, dropout=0.0, **chosen))
        training._build(folder)
        made, _ = updating(training.module)
        batch = training.batches.batch(0)
        assert [len(part) for part in made._parts(batch)] == {1: [1] * 16, 12: [3] * 5 + [1]}.get(budget, [16])
        made.training_step(batch, 0)
        after.append({**made.state_dict(), "loss": made.loss, "sums": made.sums})
    for other in after[1:]:
        for name, value in after[0].items():
            torch.testing.assert_close(value, other[name], rtol=1e-3, atol=1e-5, msg=name)


def test_pictures_ask_for_smaller_parts(tmp_path, monkeypatch):
    training = DTTraining(options(random_store(tmp_path / "d.h5"), **FRESH))
    training._build(tmp_path)
    window = 4 * 4 * 2 * 8 * 8  # floats of four stacks of two
    monkeypatch.setattr(of_module, "_PICTURE_BYTES", {"cpu": 5 * window})
    assert [len(part) for part in training.module._parts(training.batches.batch(0))] == [5, 5, 5, 1]


def test_an_update_is_that_of_adamw(store):
    """Betas, decay of linear weights alone, clipping, the rate after these tokens."""
    batch, net = batches(store).batch(0), network()
    reference = network()
    made, _ = updating(module(net, warmup_tokens=100, tokens=1000))
    named = dict(reference.named_parameters())
    matrices = {f"{name}.weight" for name, part in reference.named_modules() if isinstance(part, torch.nn.Linear)}
    rates = []
    state = {name: [torch.zeros_like(weight), torch.zeros_like(weight)] for name, weight in named.items()}
    for step in range(1, 4):
        made.training_step(batch, step)
        loss, _ = module(reference).evaluate(batch)
        gradients = torch.autograd.grad(loss / batch.steps, list(named.values()))
        norm = math.sqrt(sum(float(g.square().sum()) for g in gradients))
        rates.append(1e-3 * min(1.0, step * batch.steps / 100))
        with torch.no_grad():
            for (name, weight), gradient in zip(named.items(), gradients, strict=True):
                clipped = gradient * min(1.0, 1.0 / norm)
                first, second = state[name]
                first.mul_(0.9).add_(0.1 * clipped)
                second.mul_(0.95).add_(0.05 * clipped**2)
                if name in matrices:
                    weight.mul_(1 - rates[-1] * 0.1)
                weight.sub_(rates[-1] * (first / (1 - 0.9**step)) / ((second / (1 - 0.95**step)).sqrt() + 1e-8))
        assert made.rate == pytest.approx(rates[-1])
    assert norm > 1.0 and rates[0] < rates[1]
    for name, weight in net.named_parameters():
        told = state[name][1].sqrt() > 1e-6  # biases of keys have no gradient but rounding
        assert told.any() or name == "positions" or "beginnings" in name
        torch.testing.assert_close(weight[told], named[name][told], rtol=1e-4, atol=1e-6, msg=name)
    assert made.read == 3 * batch.steps and made.sums[2] == 3 * batch.steps


def test_only_weights_of_linear_layers_and_convolutions_decay(tmp_path):
    training = DTTraining(options(random_store(tmp_path / "d.h5"), **FRESH))
    training._build(tmp_path)
    decayed, kept = training.module.configure_optimizers().param_groups
    names = {id(weight): name for name, weight in training.module.named_parameters()}
    of_decayed = {names[id(weight)] for weight in decayed["params"]}
    of_kept = {names[id(weight)] for weight in kept["params"]}
    assert decayed["weight_decay"] == 0.1 and kept["weight_decay"] == 0.0
    assert of_decayed | of_kept == set(names.values()) and not of_decayed & of_kept
    assert all(name.endswith("weight") for name in of_decayed) and any("encoder.stacks" in n for n in of_decayed)
    embeddings = {"network.actions.weight", "network.beginnings.weight", "network.positions"}
    assert embeddings <= of_kept and not any("norm" in name for name in of_decayed)


def test_the_learning_rate_rises_and_falls_to_a_tenth():
    assert [schedule(read, 100, 1100) for read in (1, 50, 100)] == pytest.approx([0.01, 0.5, 1.0])
    assert schedule(350, 100, 1100) == pytest.approx(0.5 * (1 + math.cos(math.pi / 4)))
    assert schedule(1000, 100, 1100) == schedule(1100, 100, 1100) == schedule(5000, 100, 1100) == 0.1
    assert schedule(7, 0, 7) == 0.1 and schedule(7, 7, 7) == 1.0


@pytest.mark.parametrize(("epochs", "wanted"), [(5, [0.93, 0.75, 0.5, 0.25, 0.1]), (8, [0.96, 0.85, 0.69, 0.5, 0.31])])
def test_the_learning_rate_falls_over_six_epochs_as_published_or_over_more(tmp_path, epochs, wanted):
    """``final_tokens = 2 * len(train_dataset) * context * 3``, of which an epoch counts ``context`` a window."""
    training = DTTraining(options(random_store(tmp_path / "d.h5"), epochs=epochs, warmup_tokens=0, **FRESH))
    training._build(tmp_path)
    made, steps = training.module, training.batches.windows.lengths.sum()
    ends = [schedule(epoch * steps, made.warmup_tokens, made.tokens) for epoch in range(1, epochs + 1)]
    assert ends[:5] == pytest.approx(wanted, abs=0.005) and ends[-1] == pytest.approx(0.1)
