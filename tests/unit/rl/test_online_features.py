"""What an online agent sees with: gradients, modes, and where encoder and bottleneck come from."""

from __future__ import annotations

import copy

import pytest
import torch
from online_snapshots import FRESH, PIXELS, STACK, WIDTH, ddpg_options, make_run, parts, quantiser

from repdib_lightning.bottlenecks import Identity, Variational
from repdib_lightning.errors import UserError
from repdib_lightning.export import load_encoder
from repdib_lightning.rl.online_encoder import TrainedFeatures, evaluated, given_encoder, trained_parts

WEIGHTS = {"kl": 0.01, "commitment": 0.25, "codebook": 1.0}


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    return make_run(tmp_path_factory.mktemp("explored") / "x")


def pictures(count=8, seed=0):
    generator = torch.Generator().manual_seed(seed)
    shape = (count, 3 * STACK, PIXELS, PIXELS)
    return {"pixels": torch.randint(0, 256, shape, generator=generator, dtype=torch.uint8)}


def state(module):
    return {name: value.clone() for name, value in module.state_dict().items()}


def same(one, other):
    return all(torch.equal(one[name], other[name]) for name in one)


@pytest.mark.parametrize("weight", [1.0, 0.3, 0.0])
@pytest.mark.parametrize("kind", ["none", "vib", "repdib"])
def test_gradients_are_those_of_the_explicit_sum(kind, weight):
    made = {"none": Identity, "vib": Variational}
    encoder, bottleneck = parts(made[kind](WIDTH) if kind in made else quantiser())
    explicit = copy.deepcopy((encoder, bottleneck))
    features = TrainedFeatures(encoder, bottleneck, shift=0, losses_weight=weight)
    torch.manual_seed(1)
    features(pictures()).square().mean().backward()
    torch.manual_seed(1)
    output = explicit[1](explicit[0](pictures()))
    loss = output.latent.square().mean()
    for name, value in output.losses.items():
        loss = loss + weight * WEIGHTS[name] * value
    loss.backward()
    wanted = [parameter.grad for part in explicit for parameter in part.parameters()]
    found = [parameter.grad for part in (encoder, bottleneck) for parameter in part.parameters()]
    for one, other in zip(found, wanted, strict=True):
        torch.testing.assert_close(one, other)
    assert set(output.losses) <= set(features.latest)


def test_pictures_are_shifted_in_training_alone():
    encoder, _ = parts()
    features = TrainedFeatures(encoder, Identity(WIDTH), shift=3, losses_weight=1.0)
    plain = encoder(pictures())
    assert not torch.allclose(features(pictures()), plain) and not torch.allclose(features.later(pictures()), plain)
    torch.testing.assert_close(features.eval()(pictures()), plain)
    unshifted = TrainedFeatures(encoder, Identity(WIDTH), shift=0, losses_weight=1.0)
    torch.testing.assert_close(unshifted(pictures()), plain)
    torch.testing.assert_close(unshifted.later(pictures()), plain)


def test_what_is_bootstrapped_from_leaves_no_trace():
    features = TrainedFeatures(*parts(), shift=0, losses_weight=1.0)
    before = state(features)
    later = features.later(pictures())
    assert not later.requires_grad and same(before, state(features)) and features.training
    torch.testing.assert_close(later, features.later(pictures()))  # no noise
    assert features(pictures()).requires_grad and not same(before, state(features))  # codebooks follow


def test_evaluating_leaves_every_mode_as_it_was():
    encoder, bottleneck = parts()
    encoder.train(), bottleneck.train()
    encoder.trunk[1].eval()
    modes = [module.training for part in (encoder, bottleneck) for module in part.modules()]
    torch.testing.assert_close(
        evaluated(encoder, bottleneck, pictures()), evaluated(encoder.eval(), bottleneck.eval(), pictures())
    )
    encoder.train(), bottleneck.train()
    encoder.trunk[1].eval()
    evaluated(encoder, bottleneck, pictures())
    assert modes == [module.training for part in (encoder, bottleneck) for module in part.modules()]


@pytest.mark.parametrize("frames", [1000, 2000, None])
def test_the_snapshot_that_was_named(run, frames):
    given = given_encoder(ddpg_options(encoder=run, snapshot=frames))
    assert given.facts["frames"] == (frames or 2000)
    torch.testing.assert_close(given.encoder.encode(pictures()), load_encoder(given.bundle).encode(pictures()))
    again = given_encoder(ddpg_options(encoder=given.bundle))
    assert again.facts == given.facts and again.bundle == given.bundle


def test_without_the_bottleneck_the_encoder_speaks_for_itself(run):
    whole = given_encoder(ddpg_options(encoder=run)).encoder
    bare = given_encoder(ddpg_options(encoder=run, bottleneck=False)).encoder
    torch.testing.assert_close(bare.encode(pictures()), whole.encoder(pictures()))
    assert not torch.allclose(bare.encode(pictures()), whole.encode(pictures())) and bare.groups == 0


@pytest.mark.parametrize("bottleneck", [True, False])
def test_what_is_trained_begins_as_what_was_given(run, bottleneck):
    options = ddpg_options(encoder=run, frozen=False, bottleneck=bottleneck)
    given = given_encoder(options)
    made = trained_parts(options, given, (3, PIXELS, PIXELS))
    torch.testing.assert_close(evaluated(*made, pictures()), given.encoder.encode(pictures()))
    assert all(parameter.requires_grad for parameter in made[0].parameters())
    assert isinstance(made[1], Identity) is not bottleneck


def test_a_fresh_encoder_is_as_chosen_and_of_its_seed():
    def made(seed):
        return trained_parts(ddpg_options(task="walker-run", seed=seed, **FRESH), given, (3, PIXELS, PIXELS))[0]

    given = given_encoder(ddpg_options(task="walker-run"))
    encoder = made(0)
    assert encoder.features == 8 and encoder.spec.frame_stack == 2
    assert encoder.spec.observations["pixels"].shape == (6, PIXELS, PIXELS)
    assert same(state(encoder), state(made(0))) and not same(state(encoder), state(made(1)))


def test_what_is_not_there_is_told(run, tmp_path):
    for options, said in (
        ({"encoder": run, "snapshot": 3}, "--snapshot 3: not in .*x, which has 1000, 2000"),
        ({"encoder": tmp_path}, "holds no bundle; export one"),
        ({"encoder": tmp_path / "no"}, "no such bundle; export one"),
    ):
        with pytest.raises(UserError, match=said):
            given_encoder(ddpg_options(**options))
