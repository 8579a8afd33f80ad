"""Prototypes beside the published recipe written out, and two processes beside one."""

from __future__ import annotations

import math

import pytest
import torch
from torch import distributed, multiprocessing, nn
from torch.nn.parallel import DistributedDataParallel

from repdib_lightning.objectives import Prototypes
from repdib_lightning.objectives.prototypes import sinkhorn
from repdib_lightning.records import ArraySpec, Batch, DataSpec

M, B, P, K = 6, 7, 5, 9
SPEC = DataSpec({"x": ArraySpec((M,), "float32")}, horizon=1)


def built(**options):
    torch.manual_seed(0)
    small = {"prototypes": K, "projected": P, "hidden": 8, "temperature": 0.2}
    return Prototypes(M, SPEC, **{**small, **options}).double()


def batch(count=B, frames=2):
    generator = torch.Generator().manual_seed(1)
    drawn = torch.randn(count, frames, M, generator=generator, dtype=torch.float64)
    return Batch({"x": drawn}, None, torch.ones(count, frames, dtype=torch.int64), torch.arange(count))


def part(data, rows):
    return Batch({"x": data.observations["x"][rows]}, None, data.offsets[rows], data.rows[rows])


def online(observations):
    return observations["x"]


def target(observations):
    """Another network than the online one."""
    return observations["x"].flip(-1) + 0.3


def slow_sinkhorn(scores, iterations):
    """Exponentials, scaled one prototype and one sample at a time."""
    shares = [[math.exp(score) for score in row] for row in scores.tolist()]
    total = sum(map(sum, shares))
    shares = [[share / total for share in row] for row in shares]
    for _ in range(iterations):
        for k in range(len(shares[0])):
            held = sum(row[k] for row in shares)
            for row in shares:
                row[k] /= held * len(shares[0])
        for row in shares:
            held = sum(row)
            row[:] = [share / (held * len(shares)) for share in row]
    return torch.tensor([[share / sum(row) for share in row] for row in shares], dtype=torch.float64)


def unit(row):
    return row / row.square().sum().sqrt()


def slow_standardised(rows):
    """Less the mean of the batch, over its deviation."""
    mean = sum(rows) / len(rows)
    variance = sum((row - mean) ** 2 for row in rows) / len(rows)
    return [(row - mean) / (variance + 1e-5).sqrt() for row in rows]


def slow(objective, data, tau=0.2, iterations=3):
    """One sample and one prototype at a time; the target's predictor has moved away from the online one."""
    frames, copied = data.observations["x"], objective.target_predictor
    prototypes = [unit(row) for row in objective.prototypes.weight]
    first, _, second = objective.projector
    predicted, later = [], []
    before = [objective.predictor.weight @ row + objective.predictor.bias for row in frames[:, 0]]
    after = [copied.weight @ row + copied.bias for row in target({"x": frames})[:, -1].detach()]
    if not isinstance(objective.standardised, nn.Identity):
        before, after = (slow_standardised(rows) for rows in (before, after))
    for embedded, averaged in zip(before, after, strict=True):
        hidden = (first.weight @ embedded + first.bias).clamp_min(0)
        s = unit(second.weight @ hidden + second.bias)
        scores = torch.stack([prototype @ s / tau for prototype in prototypes])
        predicted.append(scores - scores.exp().sum().log())
        t = unit(averaged)
        later.append(torch.stack([prototype @ t / tau for prototype in prototypes]))
    assigned = slow_sinkhorn(torch.stack(later).detach(), iterations)
    return -sum((q * p).sum() for q, p in zip(assigned, predicted, strict=True)) / len(frames)


def moved(objective):
    """Let predictor and its running average part."""
    generator = torch.Generator().manual_seed(2)
    with torch.no_grad():
        for weight in objective.predictor.parameters():
            weight += torch.randn(weight.shape, generator=generator, dtype=weight.dtype)
        objective.prototypes.weight *= torch.rand(K, 1, generator=generator, dtype=torch.float64) + 0.5
    return objective


@pytest.mark.parametrize("standardise", [False, True])
@pytest.mark.parametrize("frames", [2, 3])
def test_loss_and_gradients_equal_those_of_loops(frames, standardise):
    objective, data = moved(built(standardise=standardise)), batch(frames=frames)
    rows = data.observations["x"].requires_grad_()
    wanted = [rows, *objective.parameters()]
    output = objective(data, online, lambda observations: target(observations).detach())
    loss = slow(objective, data)
    assert output.losses.keys() == {"prototypes"}
    torch.testing.assert_close(output.losses["prototypes"], loss)
    ours = torch.autograd.grad(output.losses["prototypes"], wanted)
    names = ["rows", *(name for name, _ in objective.named_parameters())]
    for name, gradient, expected in zip(names, ours, torch.autograd.grad(loss, wanted), strict=True):
        torch.testing.assert_close(gradient, expected)
        assert gradient.abs().sum() > 1e-6 or (standardise and name == "predictor.bias")
    assert ours[0][:, 0].abs().sum() > 0 and ours[0][:, 1:].abs().sum() == 0


@pytest.mark.parametrize("iterations", [1, 3, 10])
def test_the_assignment_equals_that_of_loops(iterations):
    scores = 3 * torch.randn(B, K, generator=torch.Generator().manual_seed(3), dtype=torch.float64)
    torch.testing.assert_close(sinkhorn(scores, iterations), slow_sinkhorn(scores, iterations))


class Learner(nn.Module):
    """An encoder, its target and the objective, as one module for distributed training."""

    def __init__(self):
        super().__init__()
        self.objective = moved(built(standardise=True))
        self.encoder = nn.Linear(M, M).double()

    def forward(self, data):
        return self.objective(data, lambda seen: self.encoder(seen["x"]), target)


def results(learner, plain, data, held_out):
    output = learner(data)
    output.losses["prototypes"].backward()
    gradients = {key: parameter.grad for key, parameter in plain.named_parameters()}
    plain.eval()
    with torch.no_grad():
        later = plain(held_out)
    values = [{name: value.detach() for name, value in (o.losses | o.metrics).items()} for o in (output, later)]
    return {"train": values[0], "held_out": values[1], "gradients": gradients}


def one_of_two(rank, folder):
    torch.set_num_threads(1)
    learner = Learner()
    distributed.init_process_group("gloo", init_method=f"file://{folder}/rendezvous", rank=rank, world_size=2)
    shares = part(batch(8), slice(4 * rank, 4 * rank + 4))
    uneven = part(batch(7), slice(3) if rank == 0 else slice(3, 7))
    torch.save(results(DistributedDataParallel(learner), learner, shares, uneven), f"{folder}/{rank}.pt")
    distributed.destroy_process_group()


@pytest.fixture(scope="module")
def both(tmp_path_factory):
    folder = tmp_path_factory.mktemp("prototypes")
    multiprocessing.spawn(one_of_two, args=(str(folder),), nprocs=2)
    return [torch.load(folder / f"{rank}.pt", weights_only=True) for rank in range(2)]


def test_two_processes_train_on_the_loss_of_one(both):
    learner = Learner()
    alone = results(learner, learner, batch(8), batch(7))
    for key, value in alone["train"].items():
        torch.testing.assert_close((both[0]["train"][key] + both[1]["train"][key]) / 2, value)
    for key, gradient in alone["gradients"].items():
        torch.testing.assert_close(both[0]["gradients"][key], gradient)
        assert torch.equal(both[0]["gradients"][key], both[1]["gradients"][key])


def test_unequal_shares_of_held_out_samples_make_up_the_whole(both):
    learner = Learner()
    alone = results(learner, learner, batch(8), batch(7))["held_out"]
    for key, value in alone.items():
        torch.testing.assert_close((3 * both[0]["held_out"][key] + 4 * both[1]["held_out"][key]) / 7, value)
