"""Training of Atari policies: one life an episode, the same values as Stable-Baselines3's, a file that plays."""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch

from repdib_lightning.__main__ import main
from repdib_lightning.environments.atari_env import AtariEnv
from repdib_lightning.environments.atari_network import NatureNetwork, read_atari_policy
from repdib_lightning.environments.train_atari_policy import OneLife, state_of, train_atari_policy

pytest.importorskip("ale_py")
pytest.importorskip("cv2")
DQN = pytest.importorskip("stable_baselines3").DQN


def test_a_lost_life_ends_an_episode_and_the_next_one_goes_on_in_the_same_game():
    env, random = OneLife(AtariEnv("qbert", noop_max=1)), np.random.default_rng(0)
    plain = AtariEnv("qbert", noop_max=1)
    seen, _ = env.reset(seed=0)
    assert np.array_equal(seen, plain.reset(seed=0)[0])
    lost, games, clipped, rewards = 0, 0, [], []
    while not games:
        action = random.integers(2, 6)
        seen, reward, over, truncated, _ = env.step(action)
        theirs, plain_reward, games, *_ = plain.step(action)
        assert np.array_equal(seen, theirs) and not truncated
        clipped.append(reward)
        rewards.append(plain_reward)
        if over and not games:
            lost += 1
            assert np.array_equal(env.reset()[0], plain.step(0)[0])
    assert over and lost == 3  # Qbert has four
    assert max(rewards) > 1 and clipped == np.sign(rewards).tolist() and 1.0 in clipped
    assert np.array_equal(env.reset(seed=1)[0], plain.reset(seed=1)[0])


def test_values_are_those_of_stable_baselines3():
    agent = DQN("CnnPolicy", AtariEnv("pong", frame_stack=4), buffer_size=1, seed=0, device="cpu")
    network = NatureNetwork(4, 84, 6)
    network.load_state_dict(state_of(agent))
    frames = torch.from_numpy(np.random.default_rng(0).integers(256, size=(3, 4, 84, 84), dtype=np.uint8))
    with torch.no_grad():
        assert torch.allclose(network(frames), agent.q_net(frames), atol=1e-6)
        kept = state_of(agent)["layers.9.bias"].clone()
        agent.q_net.q_net[0].bias += 1
        assert torch.allclose(network(frames) + 1, agent.q_net(frames), atol=1e-5)
    assert torch.equal(network.state_dict()["layers.9.bias"], kept)


def test_networks_of_the_ages_that_were_asked_for_are_kept_and_differ(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr("repdib_lightning.environments.train_atari_policy.MAX_FRAMES", 200)
    small = {"steps": 60, "keep": [20], "buffer": 100, "learning_starts": 8, "train_freq": 8, "episodes": 1}
    path = train_atari_policy(tmp_path / "p.safetensors", game="Breakout", device="cpu", **small)
    read = read_atari_policy(path, game="breakout", frame_skip=4, image_size=84)
    assert read.ages == [20, 60] and read.names == ["dqn-20", "dqn-60"]
    first, last = (read.network(age).state_dict() for age in read.ages)
    assert not torch.equal(first["layers.0.weight"], last["layers.0.weight"])
    assert (read.facts["sticky"], read.facts["stack"], read.facts["actions"]) == (0.0, 4, 4)
    told = capsys.readouterr().err
    for age in ("20", "60"):
        assert f"breakout: {age} steps, return {read.facts['networks'][age]['return']:.1f}" in told
    again = train_atari_policy(tmp_path / "q.safetensors", game="breakout", device="cpu", progress=False, **small)
    other = read_atari_policy(again, game="breakout", frame_skip=4, image_size=84).network().state_dict()
    assert all(torch.equal(other[key], last[key]) for key in last)
    assert "q.safetensors --game breakout --steps 60 --keep '[20, 60]'" in str(
        read_atari_policy(again, game="breakout", frame_skip=4, image_size=84).facts["command"]
    )


@pytest.fixture
def complain(tmp_path, monkeypatch, capsys) -> Callable[..., str]:
    """Run ``collect atari_policy``, which must fail; return its one line."""
    monkeypatch.chdir(tmp_path)

    def run(*options: str, path: str = "p.safetensors") -> str:
        assert main(["collect", "atari_policy", path, "--progress", "false", *options]) == 2
        error = capsys.readouterr().err.splitlines()
        assert len(error) == 1
        return error[0]

    return run


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["--game", "Breakot"], "game=Breakot: unknown, did you mean 'breakout'?"),
        (["--steps", "0"], "steps=0: must be at least 1"),
        (["--steps", "50", "--keep", "[20, 60]"], "keep: 60 is not one of the 50 steps"),
        (["--keep", "[0]"], "keep: 0 is not one of the 300000 steps"),
        (["--learning_rate", "0"], "learning_rate=0.0: must be above 0"),
        (["--seed", "-1"], "seed=-1: must be from 0 to"),
        (["--buffer", "0"], "buffer=0: must be at least 1"),
        (["--learning_starts", "-1"], "learning_starts=-1: must be at least 0"),
        (["--device", "gpu"], "device 'gpu' cannot be used here, "),
        (["--sticky", "-0.1"], "sticky=-0.1: must be at least 0"),
    ],
)
def test_bad_options_are_one_line(complain, options, said):
    assert said in complain(*options)


def test_a_path_that_cannot_be_written_and_what_is_not_installed_are_one_line(complain, monkeypatch):
    assert "policies must end in" not in complain(path="p.zip") and "must end in .safetensors" in complain(path="p.zip")
    Path("there.safetensors").write_text("mine")
    assert "there.safetensors: exists already" in complain(path="there.safetensors")
    monkeypatch.setitem(sys.modules, "stable_baselines3", None)
    assert "collect atari_policy needs Stable-Baselines3: pip install 'repdib_lightning[rl]'" in complain()
