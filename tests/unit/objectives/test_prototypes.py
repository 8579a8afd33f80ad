"""Prototypes: an even spread, no gradient into the target, and a toy run that neither stands still nor collapses."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from torch import nn

from repdib_lightning.bottlenecks import Identity, RepDIB
from repdib_lightning.data.datamodule import EpisodeDataModule
from repdib_lightning.data.writer import EpisodeWriter
from repdib_lightning.encoders import ConvolutionalEncoder
from repdib_lightning.errors import UserError
from repdib_lightning.objectives import OBJECTIVES, Prototypes
from repdib_lightning.objectives.prototypes import sinkhorn
from repdib_lightning.records import ArraySpec, Batch, DataSpec
from repdib_lightning.representation import RepresentationModule

M = 6
SPEC = DataSpec({"x": ArraySpec((M,), "float32")}, horizon=1)
SMALL = {"prototypes": 12, "projected": 5, "hidden": 16}


def built(**options):
    torch.manual_seed(0)
    return Prototypes(M, SPEC, **{**SMALL, **options})


def batch(count=16, frames=2):
    generator = torch.Generator().manual_seed(0)
    drawn = torch.randn(count, frames, M, generator=generator)
    return Batch({"x": drawn}, None, torch.ones(count, frames, dtype=torch.int64), torch.arange(count))


def encode(observations):
    return observations["x"]


def test_every_sample_is_whole_and_every_prototype_has_its_share():
    scores = 10 * torch.randn(40, 8, generator=torch.Generator().manual_seed(0))
    shares = sinkhorn(scores, 3)
    torch.testing.assert_close(shares.sum(1), torch.ones(40))
    uneven = [(sinkhorn(scores, rounds).sum(0) - 5).abs().max() for rounds in (1, 3, 100)]
    assert uneven[0] > uneven[1] > uneven[2] and uneven[2] < 0.01


def test_the_spread_keeps_what_is_near():
    """As many samples as prototypes, each clearly at one: each stays there."""
    order = torch.randperm(9, generator=torch.Generator().manual_seed(0))
    torch.testing.assert_close(sinkhorn(10 * torch.eye(9)[order], 3), torch.eye(9)[order], atol=1e-3, rtol=0)


def test_samples_that_are_alike_are_spread_evenly():
    scores = torch.randn(1, 8, generator=torch.Generator().manual_seed(0)).expand(5, 8)
    torch.testing.assert_close(sinkhorn(scores, 1), torch.full((5, 8), 1 / 8))


@pytest.mark.parametrize("scale", [1e4, 1e30])
def test_no_score_is_too_large(scale):
    scores = scale * torch.randn(6, 8, generator=torch.Generator().manual_seed(0))
    shares = sinkhorn(scores, 3)
    assert shares.isfinite().all()
    torch.testing.assert_close(shares.sum(1), torch.ones(6))


def test_an_offset_of_a_sample_changes_nothing():
    scores = torch.randn(6, 8, dtype=torch.float64)
    moved = scores + torch.randn(6, 1, dtype=torch.float64)
    assert not torch.allclose(scores.softmax(0), moved.softmax(0))
    wanted = sinkhorn(scores, 200)
    torch.testing.assert_close(sinkhorn(moved, 200), wanted, rtol=1e-6, atol=1e-9)


def test_the_gradient_reaches_every_weight_but_not_the_target():
    objective, data = built(), batch(frames=3)
    before, after = nn.Linear(M, M), nn.Linear(M, M)
    output = objective(data, lambda seen: before(seen["x"]), lambda seen: after(seen["x"]))
    output.losses["prototypes"].backward()
    for name, weight in [*objective.named_parameters(), *before.named_parameters()]:
        assert weight.grad.abs().sum() > 0, name
    assert all(weight.grad is None for weight in after.parameters())
    assert not any(buffer.requires_grad for buffer in objective.buffers())


def test_the_online_network_sees_the_anchor_and_the_target_the_last_frame():
    seen, data = {}, batch(frames=4)

    def noting(name):
        def note(observations):
            assert name not in seen
            seen[name] = observations["x"]
            return observations["x"]

        return note

    built()(data, noting("online"), noting("target"))
    assert torch.equal(seen["online"], data.observations["x"][:, :1])
    assert torch.equal(seen["target"], data.observations["x"][:, 3:])


def test_the_length_of_a_prototype_means_nothing():
    objective, data = built(), batch()
    first = objective(data, encode, encode).losses["prototypes"]
    with torch.no_grad():
        objective.prototypes.weight *= torch.rand(12, 1) + 0.1
    torch.testing.assert_close(objective(data, encode, encode).losses["prototypes"], first)


def test_nothing_moves_in_a_pass_and_the_target_head_only_when_told():
    objective, data = built(target_rate=0.25), batch()
    start = {name: value.clone() for name, value in objective.state_dict().items()}
    for training in (False, True):
        objective.train(training)(data, encode, encode)
        assert all(torch.equal(value, start[name]) for name, value in objective.state_dict().items())
    with torch.no_grad():
        objective.predictor.weight.add_(1.0)
    objective.follow()
    state = objective.state_dict()
    torch.testing.assert_close(state["target_predictor.weight"], start["target_predictor.weight"] + 0.25)
    assert torch.equal(state["target_predictor.bias"], start["target_predictor.bias"])


def test_the_metrics_tell_a_collapse_from_a_spread():
    objective, data = built(prototypes=4), batch(count=8)
    data.observations["x"][:] = data.observations["x"][:1, :1]
    collapsed = objective(data, encode, encode).metrics
    assert collapsed["prototype_perplexity"] == pytest.approx(1.0)
    assert collapsed["prototype_nats"] == pytest.approx(0.0, abs=1e-5)
    objective = built(prototypes=4, projected=4, temperature=0.01)
    objective.projector = nn.Identity()
    with torch.no_grad():
        objective.prototypes.weight.copy_(torch.eye(4))
        objective.predictor.weight.copy_(torch.eye(4, M))
        objective.predictor.bias.zero_()
    data.observations["x"][:] = torch.eye(4, M).repeat(2, 1)[:, None]
    spread = objective(data, encode, encode).metrics
    assert spread["prototype_perplexity"] == pytest.approx(4.0)
    assert spread["prototype_nats"] == pytest.approx(math.log(4))
    assert not any(value.requires_grad for value in spread.values())


def test_an_embedding_is_the_predictor_s_direction():
    objective, latents = built(), torch.randn(7, M)
    embedded = objective.embed(latents)
    assert embedded.shape == (7, objective.projected)
    torch.testing.assert_close(embedded.norm(dim=1), torch.ones(7))
    given = objective.predictor(latents)
    torch.testing.assert_close(embedded * given.norm(dim=1, keepdim=True), given)


def test_candidates_are_drawn_by_the_softmax_over_the_batch():
    """Of many prototypes that are all the same, the shares are the chances of each embedding."""
    objective = built(prototypes=40_000)
    with torch.no_grad():
        objective.prototypes.weight.copy_(torch.tensor([3.0, 0, 0, 0, 0]).expand(40_000, 5))
    embeddings = torch.eye(5)[:3]
    drawn = objective.candidates(embeddings)
    assert drawn.shape == (40_000,) and drawn.dtype == torch.int64
    shares = torch.bincount(drawn, minlength=3) / 40_000
    wanted = torch.tensor([1.0, 0.0, 0.0]).softmax(0)  # cosines, without the temperature
    torch.testing.assert_close(shares, wanted, atol=0.01, rtol=0)


def test_single_precision_under_autocast():
    objective, data = built().eval(), batch()
    plain = objective(data, encode, encode).losses["prototypes"]
    with torch.autocast("cpu", dtype=torch.bfloat16):
        cast = objective(data, encode, encode).losses["prototypes"]
        assert objective.embed(data.observations["x"][:, 0].bfloat16()).dtype == torch.float32
    assert torch.equal(plain, cast)


def test_a_lone_sample_is_refused_in_training_and_harmless_after():
    objective, alone = built(), batch(count=1)
    with pytest.raises(UserError, match=r"data.batch_size is 1: Prototypes spreads .* needs at least 2"):
        objective(alone, encode, encode)
    output = objective.eval()(alone, encode, encode)
    assert all(value.isfinite() for value in (output.losses | output.metrics).values())


def test_bad_options():
    with pytest.raises(UserError, match=r"Prototypes: .*set data.futures to at least 1"):
        Prototypes(M, DataSpec(SPEC.observations, horizon=0))
    Prototypes(M, DataSpec(SPEC.observations, horizon=0, next_frame=True))
    for name, least in (("prototypes", 2), ("projected", 1), ("hidden", 1), ("sinkhorn_iterations", 1)):
        with pytest.raises(UserError, match=f"Prototypes: {name} must be at least {least}, is 0"):
            built(**{name: 0})
    for value in (0.0, -1.0, math.nan, math.inf):
        with pytest.raises(UserError, match="temperature must be a positive number"):
            built(temperature=value)
    for value in (0.0, 1.5, math.nan):
        with pytest.raises(UserError, match=r"target_rate must be in \(0, 1\]"):
            built(target_rate=value)
    with pytest.raises(UserError, match="make it the only objective"):
        built()(batch(), encode)
    assert OBJECTIVES["Prototypes"] is Prototypes and not Prototypes.needs_actions


def walks(path, episodes=6, length=60, size=24):
    """A bright square that walks on a ring of twelve places by single steps, amid noise."""
    generator, rows = np.random.default_rng(0), episodes * length
    pictures = {"front": ArraySpec((3, size, size))}
    with EpisodeWriter(path, rows=rows, episodes=episodes, observations=pictures, actions=None, factors={}) as writer:
        for episode in range(episodes):
            places = np.cumsum(generator.choice([-1, 0, 1], length)) % 12
            frames = generator.integers(0, 60, (length, 3, size, size)).astype(np.uint8)
            for frame, place in zip(frames, places, strict=True):
                y, x = divmod(int(place), 4)
                frame[:, 8 * y : 8 * y + 8, 6 * x : 6 * x + 6] = 255
            writer.add_episode(observations={"front": frames}, factors={}, evaluation=episode == 0)
    return path


def trained(path, bottleneck, steps=700):
    """The module, the losses of its steps, and the mean metrics of held-out samples."""
    data = EpisodeDataModule(str(path), batch_size=32, horizon=1)
    data.setup()
    torch.manual_seed(0)
    model = RepresentationModule(
        lambda spec: ConvolutionalEncoder(spec, features=16, strides=[2, 2]),
        lambda width: Identity(width) if bottleneck == "none" else RepDIB(width, groups=4, codes=8, start_step=100),
        lambda width, spec: Prototypes(width, spec, prototypes=24, projected=16, hidden=64),
        shift=0,
    ).build(data.spec)
    optimiser = torch.optim.Adam([weight for weight in model.parameters() if weight.requires_grad], 1e-3)
    losses: list[float] = []
    while len(losses) < steps:
        for samples in data.train_dataloader():
            output = model._evaluate(samples)
            optimiser.zero_grad()
            sum(value * model._weight(name) for name, value in output.losses.items()).backward()
            optimiser.step()
            model.follow_target()
            losses.append(output.losses["prototypes"].item())
    model.eval()
    metrics = [model._evaluate(samples).metrics for samples in data.val_dataloader()]
    return losses, {name: sum(part[name].item() for part in metrics) / len(metrics) for name in metrics[0]}


@pytest.mark.parametrize("bottleneck", ["none", "repdib"])
def test_it_learns_without_collapsing(tmp_path, bottleneck):
    """The loss falls below log K, at which nothing is predicted, and many prototypes are in use."""
    losses, held_out = trained(walks(tmp_path / "walks.h5"), bottleneck)
    assert losses[0] > math.log(24) > sum(losses[-10:]) / 10 + 0.3
    assert held_out["prototype_perplexity"] > 8 and held_out["prototype_nats"] > 0.25
