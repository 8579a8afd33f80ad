"""The contrastive objectives beside explicit loops over pairs, and two processes beside one."""

from __future__ import annotations

import math

import pytest
import torch
from torch import distributed, multiprocessing, nn
from torch.nn.parallel import DistributedDataParallel

from repdib_lightning.objectives import DRIML, InfoNCE
from repdib_lightning.records import ActionSpec, ArraySpec, Batch, DataSpec

M, B = 6, 7
CASES = {
    "driml discrete": (DRIML, "discrete", {"hidden": 10, "action_features": 5, "clip": 2.0}),
    "driml continuous": (DRIML, "continuous", {"hidden": 10, "action_features": 5}),
    "driml unconditioned": (DRIML, None, {"hidden": 10, "feed_action": False}),
    "info_nce": (InfoNCE, None, {"projection": 9, "temperature": 0.2}),
}


def spec(kind):
    actions = None if kind is None else ActionSpec(kind, 3)
    return DataSpec({"x": ArraySpec((M,), "float32")}, actions, horizon=4)


def build(name):
    torch.manual_seed(0)
    kind_of_objective, kind, options = CASES[name]
    return kind_of_objective(M, spec(kind), **options).double()


def batch(name, futures=2, count=B):
    generator = torch.Generator().manual_seed(1)
    frames = torch.randn(count, 1 + futures, M, generator=generator, dtype=torch.float64)
    actions = {
        "discrete": torch.randint(0, 3, (count,), generator=generator),
        "continuous": torch.randn(count, 3, generator=generator),
        None: None,
    }[CASES[name][1]]
    return Batch({"x": frames}, actions, torch.ones(count, 1 + futures, dtype=torch.int64), torch.arange(count))


def part(data, rows):
    actions = None if data.actions is None else data.actions[rows]
    return Batch({"x": data.observations["x"][rows]}, actions, data.offsets[rows], data.rows[rows])


def encode(observations):
    return observations["x"]


def block(layer, row):
    hidden = (layer.layers[0].weight @ row + layer.layers[0].bias).clamp_min(0)
    return layer.layers[2].weight @ hidden + layer.layers[2].bias + layer.skip.weight @ row


def pair_score(objective, name, before, action, after):
    """The definition, one pair at a time."""
    if isinstance(objective, InfoNCE):
        left, right = objective.anchor_head(before), objective.future_head(after)
        return left @ right / (left.norm() * right.norm()) / CASES[name][2]["temperature"]
    if action is not None:
        vector = action.double()
        if action.dtype == torch.int64:
            vector = torch.tensor([float(choice == action) for choice in range(3)], dtype=torch.float64)
        before = torch.cat([before, block(objective.action_encoder, vector)])
    clip = CASES[name][2].get("clip", 20.0)
    product = block(objective.anchor_block, before) @ block(objective.future_block, after)
    return clip * torch.tanh(product / math.sqrt(10) / clip)


def slow(objective, name, data):
    losses, hits, frames = [], [], data.observations["x"]
    for f in range(1, frames.shape[1]):
        for i in range(len(data)):
            action = None if data.actions is None else data.actions[i]
            scores = [pair_score(objective, name, frames[i, 0], action, frames[j, f]) for j in range(len(data))]
            total = sum(score.exp() for score in scores)
            losses.append(-(scores[i].exp() / total).log())
            hits.append(float(all(scores[i] >= score for score in scores)))
    return torch.stack(losses).mean(), sum(hits) / len(hits)


@pytest.mark.parametrize("futures", [1, 2])
@pytest.mark.parametrize("name", list(CASES))
def test_loss_metrics_and_gradients_equal_those_of_loops(name, futures):
    objective, data = build(name), batch(name, futures)
    frames = data.observations["x"].requires_grad_()
    wanted = [frames, *objective.parameters()]
    output = objective(data, encode)
    loss, accuracy = slow(objective, name, data)
    assert output.losses.keys() == {"contrast"}
    torch.testing.assert_close(output.losses["contrast"], loss)
    assert output.metrics["contrast_accuracy"].item() == pytest.approx(accuracy)
    assert output.metrics["contrast_nats"].item() == pytest.approx(math.log(B) - loss.item())
    ours = torch.autograd.grad(output.losses["contrast"], wanted)
    for gradient, expected in zip(ours, torch.autograd.grad(loss, wanted), strict=True):
        torch.testing.assert_close(gradient, expected)
        assert gradient.abs().sum() > 1e-6


class Learner(nn.Module):
    """An encoder and an objective, as one module for distributed training."""

    def __init__(self, name):
        super().__init__()
        self.objective = build(name)
        self.encoder = nn.Linear(M, M).double()

    def forward(self, data):
        return self.objective(data, lambda observations: self.encoder(observations["x"]))


def results(learner, plain, data, held_out):
    output = learner(data)
    output.losses["contrast"].backward()
    gradients = {key: parameter.grad for key, parameter in plain.named_parameters()}
    plain.eval()
    with torch.no_grad():
        later = plain(held_out)
    values = [
        {name: value.detach() for name, value in (part.losses | part.metrics).items()} for part in (output, later)
    ]
    return {"train": values[0], "held_out": values[1], "gradients": gradients}


def one_of_two(rank, folder):
    torch.set_num_threads(1)
    learners = {name: Learner(name) for name in CASES}
    distributed.init_process_group("gloo", init_method=f"file://{folder}/rendezvous", rank=rank, world_size=2)
    saved = {}
    for name, learner in learners.items():
        shares = part(batch(name, count=8), slice(4 * rank, 4 * rank + 4))
        uneven = part(batch(name, count=7), slice(3) if rank == 0 else slice(3, 7))
        saved[name] = results(DistributedDataParallel(learner), learner, shares, uneven)
    torch.save(saved, f"{folder}/{rank}.pt")
    distributed.destroy_process_group()


@pytest.fixture(scope="module")
def both(tmp_path_factory):
    folder = tmp_path_factory.mktemp("contrast")
    multiprocessing.spawn(one_of_two, args=(str(folder),), nprocs=2)
    return [torch.load(folder / f"{rank}.pt", weights_only=True) for rank in range(2)]


@pytest.mark.parametrize("name", list(CASES))
def test_two_processes_train_on_the_loss_of_one(both, name):
    learner = Learner(name)
    alone = results(learner, learner, batch(name, count=8), batch(name, count=7))
    first, second = (result[name] for result in both)
    for key, value in alone["train"].items():
        torch.testing.assert_close((first["train"][key] + second["train"][key]) / 2, value)
    assert alone["gradients"].keys() == first["gradients"].keys()
    for key, gradient in alone["gradients"].items():
        torch.testing.assert_close(first["gradients"][key], gradient)
        assert torch.equal(first["gradients"][key], second["gradients"][key])


@pytest.mark.parametrize("name", list(CASES))
def test_unequal_shares_of_held_out_samples_make_up_the_whole(both, name):
    """Weighed by their samples, as the means of held-out losses are."""
    learner = Learner(name)
    alone = results(learner, learner, batch(name, count=8), batch(name, count=7))["held_out"]
    first, second = (result[name]["held_out"] for result in both)
    for key, value in alone.items():
        torch.testing.assert_close((3 * first[key] + 4 * second[key]) / 7, value)
