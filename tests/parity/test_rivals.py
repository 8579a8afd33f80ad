"""EMI, DB, SVIB and forward prediction beside explicit loops, and two processes beside one."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch
from torch import distributed, multiprocessing, nn
from torch.nn import functional
from torch.nn.parallel import DistributedDataParallel

from repdib_lightning.bottlenecks import SVIB, Identity
from repdib_lightning.objectives import EMI, DynamicBottleneck, ForwardPrediction, InverseDynamics, SeveralObjectives
from repdib_lightning.records import ActionSpec, ArraySpec, Batch, DataSpec

M, B = 6, 8
SPEC = DataSpec({"x": ArraySpec((M,), "float32")}, ActionSpec("discrete", 3), horizon=4, next_frame=True)
RIVALS = {
    "forward": lambda spec: ForwardPrediction(M, spec, hidden=10),
    "emi": lambda spec: EMI(M, spec, dimensions=4, hidden=9, error_hidden=11),
    "db": lambda spec: DynamicBottleneck(M, spec, code=5, hidden=9, projection=7, momentum_rate=0.3),
}


def built(name, kind="discrete"):
    torch.manual_seed(0)
    return RIVALS[name](replace(SPEC, actions=ActionSpec(kind, 3))).double()


def batch(kind="discrete", count=B, futures=1):
    generator = torch.Generator().manual_seed(1)
    frames = 2 + torch.randn(count, 2 + futures, M, generator=generator, dtype=torch.float64)
    actions = torch.randint(0, 3, (count,), generator=generator)
    if kind == "continuous":
        actions = torch.randn(count, 3, generator=generator)
    offsets = torch.ones(count, 2 + futures, dtype=torch.int64)
    offsets[:, 0] = 0
    return Batch({"x": frames}, actions, offsets, torch.arange(count))


def part(data, rows):
    return Batch({"x": data.observations["x"][rows]}, data.actions[rows], data.offsets[rows], data.rows[rows])


def encode(observations):
    return observations["x"]


def transitions(data, kind):
    """(s, a, s') of each sample; actions as vectors."""
    frames = data.observations["x"]
    for i in range(len(data)):
        action = data.actions[i].double()
        if kind == "discrete":
            action = torch.tensor([float(choice == data.actions[i]) for choice in range(3)], dtype=torch.float64)
        yield frames[i, 0], action, frames[i, 1]


def mean(terms):
    return torch.stack(terms).mean()


def standardised(rows):
    rows = [row.detach() for row in rows]
    centre = sum(rows) / len(rows)
    scale = mean([((row - centre) ** 2).mean() for row in rows]).sqrt()
    return [(row - centre) / scale for row in rows]


def slow_forward(objective, data, kind):
    triples = list(transitions(data, kind))
    targets = standardised([after for _, _, after in triples])
    terms = []
    for (before, action, _), target in zip(triples, targets, strict=True):
        terms.append(((objective.predictor(torch.cat([before, action])) - target) ** 2).mean())
    return {"forward": mean(terms)}


def slow_emi(objective, data, kind):
    triples = list(transitions(data, kind))
    phi = [objective.state_embedding(s) for s, _, _ in triples]
    later = [objective.state_embedding(s) for _, _, s in triples]
    psi = [objective.action_embedding(a) for _, a, _ in triples]
    error = [objective.error_model(torch.cat([s.detach(), a])) for s, a, _ in triples]
    dynamics, information = [], []
    for i in range(len(triples)):
        j = (i + len(triples) // 2) % len(triples)
        dynamics.append(((later[i] - phi[i] - psi[i] - error[i]) ** 2).sum())
        total = 0.0
        for network, own, other, rest in (
            (objective.next_statistics, later[i], later[j], [phi[i], psi[i]]),
            (objective.action_statistics, psi[i], psi[j], [phi[i], later[i]]),
        ):
            joint = network.layers(torch.cat([own, *rest]))
            marginal = network.layers(torch.cat([other, *rest]))
            total = total + torch.log1p(torch.exp(-joint)) + torch.log1p(torch.exp(marginal))
        information.append(total.squeeze())
    kl = 0.0
    for d in range(4):
        values = torch.stack([row[d] for row in psi])
        sigma = (values.var(unbiased=False) + 1e-6).sqrt()
        normal = torch.distributions.Normal(values.mean(), sigma)
        kl = kl + torch.distributions.kl_divergence(normal, torch.distributions.Normal(0.0, 1.0))
    return {
        "emi_dynamics": mean(dynamics),
        "emi_error": mean([(row**2).sum() for row in error]),
        "emi_information": mean(information),
        "emi_action_kl": kl,
    }


def slow_db(objective, data, kind):
    triples = list(transitions(data, kind))
    targets = standardised([after for _, _, after in triples])
    scale = 0.1 + functional.softplus(objective.raw_scale)
    kl, prediction, scores = [], [], []
    for (before, action, _), target in zip(triples, targets, strict=True):
        raw = objective.transition(before[None], action[None])[0]
        code, sigma = raw[:5], 1e-3 + functional.softplus(raw[5:])
        kl.append(sum(0.5 * (m**2 + s**2 - 1) - s.log() for m, s in zip(code, sigma, strict=True)))
        predicted = objective.prediction(code[None])[0]
        prediction.append(-torch.distributions.Normal(predicted, scale).log_prob(target).sum())
        anchor = objective.projection(predicted)
        scores.append(
            [
                anchor @ objective.bilinear @ objective.momentum.apply_to(objective.projection, s[None])[0]
                for s in targets
            ]
        )
    contrast = [-(row[i].exp() / sum(score.exp() for score in row)).log() for i, row in enumerate(scores)]
    return {"db_kl": mean(kl), "db_prediction": mean(prediction), "db_contrast": mean(contrast)}


SLOW = {"forward": slow_forward, "emi": slow_emi, "db": slow_db}


@pytest.mark.parametrize("kind", ["discrete", "continuous"])
@pytest.mark.parametrize("name", list(RIVALS))
def test_losses_and_gradients_equal_those_of_loops(name, kind):
    """In evaluation, where codes are means and the stranger of a sample is the one half a batch on."""
    objective, data = built(name, kind).eval(), batch(kind)
    frames = data.observations["x"].requires_grad_()
    wanted = [frames, *objective.parameters()]
    output, expected = objective(data, encode).losses, SLOW[name](objective, data, kind)
    assert list(output) == list(expected)
    for key, value in output.items():
        torch.testing.assert_close(value, expected[key])
        ours = torch.autograd.grad(value, wanted, retain_graph=True, allow_unused=True)
        theirs = torch.autograd.grad(expected[key], wanted, retain_graph=True, allow_unused=True)
        for gradient, other in zip(ours, theirs, strict=True):
            assert (gradient is None) == (other is None)
            if gradient is not None:
                torch.testing.assert_close(gradient, other)


@pytest.mark.parametrize("name", list(RIVALS))
def test_every_parameter_is_reached_in_training(name):
    objective, data = built(name), batch()
    frames = data.observations["x"].requires_grad_()
    sum(objective(data, encode).losses.values()).backward()
    assert frames.grad[:, 0].abs().sum() > 0
    for key, parameter in objective.named_parameters():
        assert parameter.grad.abs().sum() > 1e-9, key


def test_the_information_of_svib_equals_loops():
    torch.manual_seed(0)
    bottleneck = SVIB(M, hidden=9, log_variance_start=-1.0).double().eval()
    latent = torch.randn(B, M, dtype=torch.float64)
    z = bottleneck.gaussian(latent).latent
    pairs = [bottleneck.statistics.layers(torch.cat([latent[i], z[i]])) for i in range(B)]
    strangers = [bottleneck.statistics.layers(torch.cat([latent[i], z[(i + B // 2) % B]])) for i in range(B)]
    expected = mean(pairs) - mean([score.exp() for score in strangers]).log()
    output = bottleneck(latent)
    torch.testing.assert_close(output.losses["information"], expected)
    torch.testing.assert_close(output.losses["estimator"], -expected)


def with_inverse(name):
    def build(width, spec):
        return RIVALS[name](spec)

    return lambda: SeveralObjectives(M, SPEC, parts=[lambda width, spec: InverseDynamics(width, spec, hidden=9), build])


CASES = {
    "svib": (lambda: SVIB(M, hidden=9, log_variance_start=-1.0), lambda: InverseDynamics(M, SPEC, hidden=9)),
    **{name: (lambda: Identity(M), with_inverse(name)) for name in RIVALS},
}


class Learner(nn.Module):
    """Encoder, bottleneck and objective as one module for distributed training."""

    def __init__(self, name):
        super().__init__()
        torch.manual_seed(0)
        bottleneck, objective = CASES[name]
        self.encoder, self.bottleneck, self.objective = nn.Linear(M, M), bottleneck(), objective()
        self.double()

    def forward(self, data):
        encoded = []

        def pass_once(observations):
            frames = observations["x"]
            encoded.append(self.bottleneck(self.encoder(frames.flatten(0, 1))))
            return encoded[0].latent.unflatten(0, frames.shape[:2])

        output = self.objective(data, pass_once)
        output.losses |= encoded[0].losses
        output.metrics |= encoded[0].metrics
        return output


NOT_MEANS = ("forward_to_copying", "emi_explained", "mean_rms")
"""Metrics that are ratios or roots of means, of each process alone."""


def results(learner, plain, data, held_out):
    torch.manual_seed(7)
    output = learner(data)
    sum(output.losses.values()).backward()
    gradients = {key: parameter.grad for key, parameter in plain.named_parameters()}
    buffers = {key: value.clone() for key, value in plain.named_buffers()}
    plain.eval()
    with torch.no_grad():
        later = plain(held_out)
    values = [
        {key: value.detach() for key, value in (half.losses | half.metrics).items() if key not in NOT_MEANS}
        for half in (output, later)
    ]
    return {"train": values[0], "held_out": values[1], "gradients": gradients, "buffers": buffers}


def one_of_two(rank, folder):
    torch.set_num_threads(1)
    learners = {name: Learner(name) for name in CASES}
    distributed.init_process_group("gloo", init_method=f"file://{folder}/rendezvous", rank=rank, world_size=2)
    saved = {}
    for name, learner in learners.items():
        shares = part(batch(), slice(4 * rank, 4 * rank + 4))
        uneven = part(batch(count=7), slice(3) if rank == 0 else slice(3, 7))
        saved[name] = results(DistributedDataParallel(learner), learner, shares, uneven)
    torch.save(saved, f"{folder}/{rank}.pt")
    distributed.destroy_process_group()


@pytest.fixture(scope="module")
def both(tmp_path_factory):
    folder = tmp_path_factory.mktemp("rivals")
    multiprocessing.spawn(one_of_two, args=(str(folder),), nprocs=2)
    return [torch.load(folder / f"{rank}.pt", weights_only=True) for rank in range(2)]


def alone(name):
    learner = Learner(name)
    return results(learner, learner, batch(), batch(count=7))


@pytest.mark.parametrize("name", list(CASES))
def test_two_processes_train_on_the_losses_of_one(both, name):
    single, (first, second) = alone(name), (result[name] for result in both)
    for key, value in single["train"].items():
        torch.testing.assert_close((first["train"][key] + second["train"][key]) / 2, value, msg=key)
    assert single["gradients"].keys() == first["gradients"].keys()
    for key, gradient in single["gradients"].items():
        torch.testing.assert_close(first["gradients"][key], gradient, msg=key)
        assert torch.equal(first["gradients"][key], second["gradients"][key])


@pytest.mark.parametrize("name", list(CASES))
def test_unequal_shares_of_held_out_samples_make_up_the_whole(both, name):
    single, (first, second) = alone(name)["held_out"], (result[name]["held_out"] for result in both)
    for key, value in single.items():
        torch.testing.assert_close((3 * first[key] + 4 * second[key]) / 7, value, msg=key)


def test_the_momentum_copies_of_the_processes_are_that_of_one(both):
    single, (first, second) = alone("db")["buffers"], (result["db"]["buffers"] for result in both)
    assert len(single) == 8 and math.isfinite(sum(value.sum().item() for value in single.values()))
    for key, value in single.items():
        assert torch.equal(first[key], second[key]) and torch.equal(first[key], value), key
