"""The policies' arithmetic against the actor of Stable-Baselines3's SAC that they are taken from."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from repdib_lightning.environments.behaviour_policy import LOG_STD_BOUNDS
from repdib_lightning.environments.control_state_env import ControlStateEnv
from repdib_lightning.environments.train_policies import network_of

SAC = pytest.importorskip("stable_baselines3").SAC


@pytest.fixture(scope="module")
def agent():
    made = SAC("MlpPolicy", ControlStateEnv("walker-walk", 20), policy_kwargs={"net_arch": [16, 12]}, seed=1)
    with torch.no_grad():  # one dimension above the bound of its standard deviation, one below
        made.policy.actor.log_std.bias[:2] = torch.tensor([5.0, -40.0])
    return made


def test_modes_and_draws_are_those_of_the_actor(agent):
    network, actor = network_of(agent), agent.policy.actor
    assert [weight.shape for weight in network.weights] == [(16, 24), (12, 16), (6, 12), (6, 12)]
    for seed in range(5):
        state = np.random.default_rng(seed).normal(0, 3, 24).astype(np.float32)
        with torch.no_grad():
            mean, log_std, _ = actor.get_action_dist_params(torch.from_numpy(state)[None])
        noise = np.random.default_rng(seed).standard_normal(6).astype(np.float32)
        drawn = torch.tanh(mean + log_std.exp() * torch.from_numpy(noise))[0].numpy()
        expected, _ = agent.predict(state, deterministic=True)
        assert np.allclose(network.act(state, None), expected, atol=1e-6)
        assert np.allclose(network.act(state, np.random.default_rng(seed)), drawn, atol=1e-6)
        assert log_std[0, :2].tolist() == [LOG_STD_BOUNDS[1], LOG_STD_BOUNDS[0]]
        assert network.act(state, None).dtype == np.float32


def test_weights_are_copies(agent):
    network = network_of(agent)
    before = network.weights[0].copy()
    with torch.no_grad():
        agent.policy.actor.latent_pi[0].weight.add_(1.0)
    assert np.array_equal(network.weights[0], before)
