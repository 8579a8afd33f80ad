"""DDPG before and while it learns a task: what it begins with, when it acts, what its updates move."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from online_snapshots import (
    EPISODE,
    FRESH,
    HIDDEN,
    OTHER_TASK,
    PIXELS,
    SCENE,
    STACK,
    TASK,
    WIDTH,
    ddpg,
    make_run,
    play_toys,
)

from repdib_lightning.errors import UserError
from repdib_lightning.export import load_encoder
from repdib_lightning.export.frozen import FrozenEncoder
from repdib_lightning.rl.exploration.collection import Collection
from repdib_lightning.rl.exploration.replay import ReplayBatch
from repdib_lightning.rl.exploration.snapshots import AGENT, read_agent
from repdib_lightning.rl.networks import Actor
from repdib_lightning.rl.online_ddpg import DDPGTraining
from repdib_lightning.rl.policy_file import load_policy


@pytest.fixture(autouse=True)
def toys(monkeypatch):
    play_toys(monkeypatch)


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    return make_run(tmp_path_factory.mktemp("explored") / "x")


@pytest.fixture
def made():
    """Makes trainings, and closes them."""
    trainings: list[DDPGTraining] = []

    def make(*arguments, **options):
        trainings.append(ddpg(*arguments, **options))
        return trainings[-1]

    yield make
    for training in trainings:
        training.close()


def pictures(count=5):
    random = np.random.default_rng(0)
    return {"pixels": random.integers(0, 256, (count, 3 * STACK, PIXELS, PIXELS), dtype=np.uint8)}


def state(*modules):
    return [value.clone() for module in modules for value in module.state_dict().values()]


def same(one, other):
    return all(torch.equal(a, b) for a, b in zip(one, other, strict=True))


def snapshots_actions(run, frames):
    """What the agent of a snapshot does, without the code under test."""
    folder = run / "snapshots" / f"frames-{frames:09d}"
    tensors, actor = read_agent(folder).part("actor."), Actor(WIDTH, 1, HIDDEN)
    actor.load_state_dict(tensors)
    return actor(load_encoder(folder).encode(pictures())).detach().numpy()


@pytest.mark.parametrize("frozen", [True, False])
@pytest.mark.parametrize("frames", [1000, 2000])
def test_a_pretrained_actor_acts_at_first_as_in_its_snapshot(run, made, frames, frozen):
    training = made(run, snapshot=frames, frozen=frozen, task=OTHER_TASK)
    np.testing.assert_allclose(training.act(pictures()), snapshots_actions(run, frames), atol=1e-6)
    assert training.resolved()["agent"] == "actor" and training.resolved()["snapshot"] == frames
    assert training.resolved()["hidden"] == HIDDEN and training.resolved()["task"] == OTHER_TASK
    assert training.task == OTHER_TASK and training.action_repeat == SCENE["action_repeat"]


def test_what_is_taken_over_is_what_was_asked_for(run, made):
    tensors = read_agent(run / "snapshots" / "frames-000002000")
    actor, both, fresh = (made(run, agent=start).agent for start in ("actor", "both", "fresh"))
    wanted = {part: [tensors.part(f"{part}.")[name] for name in getattr(actor, part).state_dict()]
              for part in ("actor", "critic", "target")}  # fmt: skip
    assert same(state(actor.actor), wanted["actor"]) and same(state(both.actor), wanted["actor"])
    assert same(state(both.critic), wanted["critic"]) and same(state(both.target), wanted["target"])
    assert not same(state(actor.critic), wanted["critic"]) and same(state(actor.critic), state(actor.target))
    assert not same(state(made(run, agent="fresh", hidden=HIDDEN).agent.actor), wanted["actor"])
    assert fresh.actor.network[0].weight.shape == (1024, WIDTH)


def test_without_the_bottleneck_the_agent_is_fresh_and_sees_other_features(run, made):
    bare, whole = made(run, bottleneck=False, hidden=HIDDEN), made(run, agent="fresh", hidden=HIDDEN)
    assert bare.resolved()["agent"] == "fresh"
    encoder = load_encoder(run / "snapshots" / "frames-000002000").encoder
    seen = {name: torch.from_numpy(array) for name, array in pictures().items()}
    torch.testing.assert_close(bare.features(pictures()), encoder(seen))
    assert not torch.allclose(bare.features(pictures()), whole.features(pictures()))


def played(training, folder, monkeypatch):
    """Train; how many actions the policy was asked for, and every action that was taken."""
    asked, taken, explore, send = [], [], training.explore, Collection._send

    def explored(observations, noise):
        asked.append(explore(observations, noise))
        return asked[-1]

    def sent(collection, actions):
        taken.append(actions)
        send(collection, actions)

    monkeypatch.setattr(training, "explore", explored)
    monkeypatch.setattr(Collection, "_send", sent)
    training.train(folder)
    return np.concatenate(asked), np.concatenate(taken)


def test_the_seed_frames_are_random_for_a_fresh_agent_and_played_by_a_loaded_one(run, made, tmp_path, monkeypatch):
    send = Collection._send
    for start, by_policy in (("fresh", 3 * EPISODE - 21), ("actor", 3 * EPISODE)):
        folder = tmp_path / start
        folder.mkdir()
        asked, taken = played(made(run, agent=start, evaluate_every=10**6), folder, monkeypatch)
        assert len(taken) == 3 * EPISODE and len(asked) == by_policy
        np.testing.assert_array_equal(taken[len(taken) - len(asked) :], asked)
        monkeypatch.setattr(Collection, "_send", send)


@pytest.mark.parametrize("frozen", [True, False])
def test_each_frame_is_encoded_once_where_that_is_enough(run, made, tmp_path, monkeypatch, frozen):
    calls, encode = [], FrozenEncoder.encode

    def counted(encoder, observations):
        calls.append(np.ndim(observations["pixels"]))
        return encode(encoder, observations)

    monkeypatch.setattr(FrozenEncoder, "encode", counted)
    made(run, frozen=frozen, shift=None if frozen else 1).train(tmp_path)
    single = sum(dimensions == 3 for dimensions in calls)
    assert single == (3 * (EPISODE + 1) if frozen else 0)  # evaluations encode batches


@pytest.mark.parametrize("frozen", [True, False])
def test_what_learning_moves(run, made, tmp_path, frozen):
    training = made(run, frozen=frozen, learning_rate=1e-2, shift=None if frozen else 1)
    seen_with = [training.frozen] if frozen else list(training.parts)
    before, agent = state(*seen_with), state(training.agent)
    training.train(tmp_path)
    assert same(before, state(*seen_with)) is frozen
    assert not any(torch.equal(a, b) for a, b in zip(agent, state(training.agent), strict=True))
    assert not list(tmp_path.glob(".replay*"))
    if not frozen:
        names = [name for part in seen_with for name, _ in part.named_parameters()]
        moved = [not torch.equal(a, b) for a, b in zip(before, state(*seen_with), strict=True)]
        assert sum(moved) >= len(names)  # the codebooks, which are buffers, too


def test_its_policy_is_read_back(run, made, tmp_path):
    for name, options in (("frozen", {}), ("trained", {"frozen": False, "shift": 1}), ("bare", {"bottleneck": False})):
        folder = tmp_path / name
        folder.mkdir()
        training = made(run, hidden=HIDDEN, learning_rate=1e-2, **options)
        training.train(folder)
        training.finish(folder)
        np.testing.assert_allclose(load_policy(folder)(pictures()), training.act(pictures()), atol=1e-5)
        assert (folder / "bundle").is_dir() is (name != "frozen")


def test_the_values_that_are_kept_are_the_critics(run, made, tmp_path):
    training = made(run)
    training.train(tmp_path)
    training.finish(tmp_path)
    kept = np.load(tmp_path / "values.npz")
    assert kept["latents"].shape == (2 * EPISODE, WIDTH)
    wanted = training.agent.values(torch.from_numpy(kept["latents"].astype(np.float32)))
    np.testing.assert_allclose(kept["values"], wanted.numpy(), atol=1e-2)


def test_an_agent_that_learns_prefers_what_is_rewarded(run, made):
    """Reward is the action itself, whatever is seen."""
    training = made(run, agent="fresh", hidden=32, learning_rate=3e-3, gamma=0.0, update_every=1, n_steps=1)
    before = training.act(pictures()).mean()
    random = torch.Generator().manual_seed(0)
    for _ in range(60):
        actions = torch.rand(64, 1, generator=random) * 2 - 1
        latents = torch.rand(64, 2, WIDTH, generator=random) * 2 - 1
        zeros = torch.zeros(64)
        training.update(
            ReplayBatch(
                observations={"latents": latents},
                actions=actions,
                offsets=torch.zeros(64, 2, dtype=torch.int64),
                rows=torch.zeros(64, dtype=torch.int64),
                returns=actions[:, 0],
                discounts=zeros,
            )
        )
    assert training.act(pictures()).mean() > max(before, 0.5)


def test_a_critic_beyond_the_limit_stops_before_it_spoils_anything(run, made, tmp_path):
    training = made(run, value_limit=1e-9)
    with pytest.raises(UserError, match=r"train/value is .*, beyond --value_limit 1e-09 after 1050 frames: the critic"):
        training.train(tmp_path)
    assert not (tmp_path / "outcome.json").exists() and not list(tmp_path.glob(".replay*"))
    np.testing.assert_allclose(load_policy(tmp_path)(pictures()), snapshots_actions(run, 2000), atol=1e-6)


@pytest.mark.parametrize("frozen", [True, False])
def test_of_an_agent_that_diverges_the_policy_of_before_is_kept(run, made, tmp_path, frozen):
    training = made(run, frozen=frozen, learning_rate=1e30, shift=None if frozen else 0)
    with pytest.raises(UserError, match=r"after 1[01][05]0 frames: the critic has diverged, try a smaller"):
        training.train(tmp_path)
    # Nothing was wrong until the first step.
    np.testing.assert_allclose(load_policy(tmp_path)(pictures()), snapshots_actions(run, 2000), atol=1e-5)


def test_what_does_not_fit_is_told(run, made, tmp_path):
    alone = tmp_path / "alone"
    alone.mkdir()
    for file in (run / "snapshots" / "frames-000001000").iterdir():
        if file.name != AGENT:
            (alone / file.name).write_bytes(file.read_bytes())
    for encoder, options, said in (
        (run, {"task": "walker-run"}, "--task walker-run: has 6 actions, .* explored cartpole-balance, which has 1; c"),
        (run, {"task": "pendulum-swingup"}, "explored cartpole-balance, which has 1; choose a task of cartpole, or"),
        (run, {"hidden": 8}, f"--hidden 8: the agent of .* has {HIDDEN}; leave it out"),
        (run, {"batch_size": 41}, "--batch_size 41: --seed_frames 1050 are 20 transitions of whole episodes; play at "
                                  "least 3050 seed frames"),
        (run, {"env_options": {"image_size": 20}}, "does not fit cartpole-balance: .*'pixels' has shape .3, 20, 20."),
        (alone, {"agent": "actor", "task": TASK, "env_options": dict(SCENE)}, "alone holds an encoder alone; name a"),
        (alone, {}, "--task: name one, such as walker-run; the encoder does not tell"),
    ):  # fmt: skip
        with pytest.raises(UserError, match=said):
            made(encoder, **options)
    assert made(alone, task=TASK, env_options={"action_repeat": 50}).resolved()["agent"] == "fresh"
    assert made(run, task="walker-run", agent="fresh").actions == 6


def test_from_scratch(made, tmp_path):
    training = made(None, task=TASK, env_options=dict(SCENE), hidden=8, **FRESH)
    before = state(*training.parts)
    training.train(tmp_path)
    assert not same(before, state(*training.parts))
    told = training.resolved()
    assert (told["features"], told["channels"], told["frozen"], told["agent"]) == (8, 2, False, "fresh")
