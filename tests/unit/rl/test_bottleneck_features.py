"""An encoder inside a policy: its gradients, what it starts from, and when it stays as it is."""

from __future__ import annotations

import copy

import numpy as np
import pytest
import torch
from gymnasium.spaces import Box, Dict
from small_trainings import PIXELS, copied, make_bundle, pictures, quantiser, spec, training
from torch import nn

from repdib_lightning.bottlenecks import Identity, Variational
from repdib_lightning.errors import UserError
from repdib_lightning.export import load_encoder
from repdib_lightning.rl.features import BottleneckFeatures

SPACE = Dict({"picture": Box(0, 255, (3, PIXELS, PIXELS), np.uint8)})
WEIGHTS = {"kl": 0.01, "commitment": 0.25, "codebook": 1.0}
"""Paper: 0.01 and 0.25; the codebook's own loss has none."""


def features(folder, bottleneck, weight):
    frozen = load_encoder(make_bundle(folder, bottleneck))
    made = BottleneckFeatures(SPACE, frozen.description, weight)
    made.encoder.load_state_dict(frozen.encoder.state_dict())
    made.bottleneck.load_state_dict(frozen.bottleneck.state_dict())
    return made


def agents_loss(head, latent):
    return (head(latent) - 1.0).square().mean()


@pytest.mark.parametrize("weight", [1.0, 3.0, 0.0])
@pytest.mark.parametrize(
    "bottleneck", [Identity(8), Variational(8), quantiser(), quantiser(codebook="gradient"), quantiser(noise="after")]
)
def test_gradients_are_those_of_the_explicit_sum(tmp_path, bottleneck, weight):
    ours = features(tmp_path / "b", bottleneck, weight).train()
    plain, head = copy.deepcopy(ours), nn.Linear(8, 2)
    observations = {"picture": pictures(6, seed=9).float()}

    torch.manual_seed(1)
    agents_loss(head, ours(observations)).backward()
    torch.manual_seed(1)
    output = plain.bottleneck(plain.encoder(observations))
    loss = agents_loss(head, output.latent)
    if weight:  # with 0 not even a gradient of zeros: what only the bottleneck's losses train has none
        loss = loss + weight * sum(WEIGHTS[name] * value for name, value in output.losses.items())
    loss.backward()

    for (name, found), wanted in zip(ours.named_parameters(), plain.parameters(), strict=True):
        assert (found.grad is None) == (wanted.grad is None), name
        if wanted.grad is not None:
            torch.testing.assert_close(found.grad, wanted.grad, rtol=1e-4, atol=1e-7, msg=name)


def test_the_weight_matters(tmp_path):
    found = []
    for weight in (0.0, 1.0):
        ours = features(tmp_path / f"{weight}", quantiser(), weight).train()
        torch.manual_seed(1)
        ours({"picture": pictures(6).float()}).sum().backward()
        found.append(torch.cat([p.grad.flatten() for p in ours.parameters()]))
    assert not torch.allclose(*found, rtol=1e-3)


def test_evaluation_is_deterministic_and_changes_no_buffer(tmp_path):
    ours = features(tmp_path / "b", quantiser(), 1.0).eval()
    before = copied(ours)
    observations = {"picture": pictures(6).float()}
    first = ours(observations)
    assert torch.equal(first, ours(observations)) and ours.latest == {}
    assert all(torch.equal(value, before[name]) for name, value in ours.state_dict().items())
    assert ours.train()(observations).shape == (6, 8) and {"kl", "commitment", "perplexity"} <= set(ours.latest)
    assert not any(value.requires_grad for value in ours.latest.values())


def test_a_description_leaves_the_random_state_and_its_weights_follow_the_seed(tmp_path):
    description = load_encoder(make_bundle(tmp_path / "b")).description
    weights = []
    for seed in (3, 3, 4):
        torch.manual_seed(seed)
        state = torch.get_rng_state()
        weights.append(BottleneckFeatures(SPACE, description).encoder.trunk[0].weight)
        assert torch.equal(state, torch.get_rng_state())
    assert torch.equal(weights[0], weights[1]) and not torch.equal(weights[0], weights[2])


@pytest.mark.parametrize("frame_stack", [1, 2])
def test_both_networks_of_an_agent_begin_as_the_bundle(tmp_path, frame_stack):
    bundle = make_bundle(tmp_path / "b", frame_stack=frame_stack)
    agent, frozen = training(bundle).agent, load_encoder(bundle)
    given = pictures(10, frame_stack=frame_stack)
    for network in (agent.q_net, agent.q_net_target):
        network.set_training_mode(False)
        with torch.no_grad():
            # As an agent gives them: floats from 0 to 255, which the encoder scales and nobody else.
            latents = network.extract_features({"picture": given}, network.features_extractor)
        assert torch.equal(latents, frozen.encode(given))
    assert torch.equal(agent.q_net.q_net[0].weight, agent.q_net_target.q_net[0].weight)


def test_a_fresh_encoder_follows_the_seed():
    weights = [training(None, seed=seed).agent.q_net.features_extractor.encoder.trunk[0].weight for seed in (0, 0, 1)]
    assert torch.equal(weights[0], weights[1]) and not torch.equal(weights[0], weights[2])
    assert spec().observations["picture"].shape == (3, PIXELS, PIXELS)


def test_a_stack_that_would_be_turned_is_refused_unless_frozen(tmp_path):
    bundle = make_bundle(tmp_path / "b", frame_stack=7)
    with pytest.raises(UserError, match=r"--encoder .*: 'picture' \(21, 20, 20\) has more channels than pixels"):
        training(bundle)
    run = training(bundle, frozen=True)
    assert run.agent.learn(8) and run.evaluation.run(run.act)["moves"] <= 12
    assert training(make_bundle(tmp_path / "six", frame_stack=6)).agent.learn(8)
