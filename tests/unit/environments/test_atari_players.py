"""Players by name, and what is wrong with a mixture."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from small_atari import SMALL_AGES, write_small

from repdib_lightning.environments.atari_game import AtariGame
from repdib_lightning.environments.atari_network import AtariPolicyFile, read_atari_policy
from repdib_lightning.environments.atari_players import NETWORK_EPSILON, check_mixture, default_mixture, player
from repdib_lightning.errors import UserError

pytest.importorskip("ale_py")
pytest.importorskip("cv2")


@pytest.fixture(scope="module")
def policy(tmp_path_factory) -> AtariPolicyFile:
    path = write_small(tmp_path_factory.mktemp("policy") / "small.safetensors")
    return read_atari_policy(path, game="breakout", frame_skip=4, image_size=36)


def game() -> AtariGame:
    made = AtariGame("breakout", image_size=36, frame_skip=4, sticky=0.0, noop_max=30, max_frames=27_000)
    made.reset(np.random.default_rng(0), np.random.default_rng(0))
    return made


@pytest.mark.parametrize(
    ("mixture", "name", "said"),
    [
        ({"randm": 1.0}, "pong", "mixture: unknown player 'randm', did you mean 'random'? (choices: dqn, dqn-STEPS, "),
        ({"scripted": 1.0}, "pong", "mixture: unknown player 'scripted', did you mean 'scripted-EPSILON'?"),
        ({"scripted-1.5": 1.0}, "pong", "mixture: scripted-1.5: the share of random actions must be from 0 to 1"),
        ({"scripted-0.1": 1.0}, "tennis", "mixture: scripted-0.1: no script plays tennis; scripts play breakout, pong"),
        ({"dqn": 1.0}, "pong", "mixture: dqn needs --policy, a file of 'collect atari_policy'"),
        ({"random": 0.5, "scripted-0": 0.4}, "pong", "mixture: the rates sum to 0.9, must sum to 1"),
        (
            {"random": 1.2, "scripted-0": -0.2},
            "pong",
            "mixture: rate of scripted-0 is -0.2, must be above 0; leave out",
        ),
        ({"random": float("nan")}, "pong", "mixture: rate of random is nan, must be above 0"),
        ({}, "pong", "mixture: the rates sum to 0, must sum to 1"),
    ],
)
def test_a_bad_mixture_is_one_line(mixture, name, said):
    with pytest.raises(UserError) as told:
        check_mixture(mixture, name, None)
    assert str(told.value).startswith(said) and "\n" not in str(told.value)


def test_networks_are_named_by_their_age(policy):
    check_mixture({"dqn": 0.5, f"dqn-{SMALL_AGES[0]}": 0.5}, "breakout", policy)
    with pytest.raises(UserError, match=r"has no network dqn-31, did you mean 'dqn-30'\? \(choices: dqn-30, dqn-400\)"):
        check_mixture({"dqn-31": 1.0}, "breakout", policy)
    with pytest.raises(UserError, match=r"small.safetensors: nobody of the mixture plays it; name dqn or dqn-400$"):
        check_mixture({"random": 1.0}, "breakout", policy)


def test_who_plays_by_default(policy):
    assert default_mixture("tennis", None) == {"random": 1.0}
    assert default_mixture("breakout", policy) == {"random": 0.1, "dqn-30": 0.45, "dqn-400": 0.45}
    for name in ("breakout", "pong", "qbert", "seaquest"):
        mixture = default_mixture(name, None)
        check_mixture(mixture, name, None)
        assert set(mixture) == {"random", "scripted-0.3", "scripted-0.1", "scripted-0.02"}


def test_a_network_sees_the_last_frames_the_first_repeated_and_draws_few_actions(policy):
    """Beside a slow version: the network of its age applied to frames stacked by hand."""
    for age, name in ((SMALL_AGES[0], f"dqn-{SMALL_AGES[0]}"), (SMALL_AGES[1], "dqn")):
        network, who, console = policy.network(age), player(name, "breakout", policy), game()
        random, same, moves = (np.random.default_rng(seed) for seed in (1, 1, 2))
        ours: list[int] = []
        for _ in range(2):
            who.begin()
            frames = [console.picture()] * 4
            for _ in range(30):
                with torch.no_grad():
                    values = network(torch.from_numpy(np.stack(frames[-4:]))[None])
                chance = same.random() < NETWORK_EPSILON
                expected = int(same.integers(4)) if chance else int(values.argmax())
                ours.append(who.act(console, random))
                assert ours[-1] == expected
                console.step(int(moves.integers(4)))
                frames.append(console.picture())
        assert len(set(ours)) > 1


def test_policies_that_cannot_play_are_one_line(tmp_path: Path):
    path = write_small(tmp_path / "p.safetensors")
    wanted = {"game": "breakout", "frame_skip": 4, "image_size": 36}
    for changed, said in (
        ({"game": "pong"}, "was trained with game=breakout, this recording has pong"),
        ({"frame_skip": 2}, "was trained with frame_skip=4, this recording has 2"),
        ({"image_size": 84}, "was trained with image_size=36, this recording has 84"),
    ):
        with pytest.raises(UserError) as told:
            read_atari_policy(path, **(wanted | changed))  # type: ignore[arg-type]
        assert str(told.value) == f"--policy {path}: {said}"
    with pytest.raises(UserError, match=r"^--policy nowhere: no such file$"):
        read_atari_policy(Path("nowhere"), **wanted)  # type: ignore[arg-type]
    for content in (b"mine", path.read_bytes()[:5000]):
        (tmp_path / "bad.safetensors").write_bytes(content)
        with pytest.raises(UserError, match=r"bad.safetensors: not a policy of 'collect atari_policy' \("):
            read_atari_policy(tmp_path / "bad.safetensors", **wanted)  # type: ignore[arg-type]
    write_small(tmp_path / "odd.safetensors", stated={"actions": 5})
    with pytest.raises(UserError, match=r"odd.safetensors: not a policy of 'collect atari_policy' \("):
        read_atari_policy(tmp_path / "odd.safetensors", **wanted)  # type: ignore[arg-type]
