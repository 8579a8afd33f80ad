"""Episodes that are asked for a return, against single ones by hand; what is asked for; how scores are told."""

from __future__ import annotations

import sys
from types import ModuleType

import numpy as np
import pytest
import torch
from small_choices import ACTIONS, FEATURES, STEPS, VIEW, Choices, network

from repdib_lightning.errors import UserError
from repdib_lightning.export.gymnasium_wrapper import PrepareObservation
from repdib_lightning.records import ArraySpec, DataSpec
from repdib_lightning.rl.decision_transformer import evaluation
from repdib_lightning.rl.decision_transformer.evaluation import ConditionedEpisodes, asked_return, game_of, scores
from repdib_lightning.rl.decision_transformer.play import Play

SPEC = DataSpec({VIEW: ArraySpec((2, 8, 8))}, frame_stack=2)


def encode(observations):
    """(n, 2, 8, 8) to (n, FEATURES), or one of them; hangs on both frames."""
    pictures = torch.from_numpy(observations[VIEW]).float().flatten(-3) / 255
    weights = torch.sin(torch.arange(pictures.shape[-1] * FEATURES).float()).view(-1, FEATURES)
    return pictures @ weights


def beginner(net, target=4.0, temperature=1.0, plays=None):
    def begin(episodes, seed):
        play = Play(net, encode, episodes=episodes, target_return=target, temperature=temperature, seed=seed)
        if plays is not None:
            plays.append(play)
        return play

    return begin


def by_hand(net, seeds, seed, target, temperature, ragged=True):
    """Each episode alone, with a full pass over the same window in each step."""
    context, returns, acted = net.sizes.context, [], []
    for number, of_reset in enumerate(seeds):
        env = PrepareObservation(Choices(ragged=ragged), SPEC)
        random = np.random.Generator(np.random.Philox(key=np.array([seed, number], np.uint64)))
        seen, _ = env.reset(seed=of_reset)
        states, to_go, actions, begin, ended = [], [target], [], 0, False
        while not ended:
            if len(states) - begin == context:
                begin += context - context // 2
            states.append(encode({VIEW: seen[VIEW][None]})[0])
            given = (torch.stack(states[begin:])[None], torch.tensor(to_go[begin:]).float()[None])
            padded = torch.tensor([*actions[begin:], 0])[None]
            logits = net(*given, padded, torch.tensor([begin]))[0, -1].double()
            if temperature == 0:
                action = int(logits.argmax())
            else:
                below = torch.softmax(logits / temperature, -1).cumsum(-1)
                action = min(int((below <= random.random()).sum()), ACTIONS - 1)
            seen, reward, _, ended, _ = env.step(action)
            actions.append(action)
            to_go.append(to_go[-1] - reward)
        returns.append(target - to_go[-1])
        acted.append(actions)
    return returns, acted


@pytest.mark.parametrize(("temperature", "chosen"), [(0.0, 2), (4.0, ACTIONS)])
def test_episodes_are_those_by_hand(temperature, chosen):
    net = network(context=3)
    environments = [Choices(ragged=True) for _ in range(6)]
    played = ConditionedEpisodes(environments, SPEC, seed=4)
    with torch.inference_mode():
        returns, films = played.play(beginner(net, 2.5, temperature))
        seeds = np.random.default_rng(4).integers(2**31, size=6).tolist()
        wanted, acted = by_hand(net, seeds, 4, 2.5, temperature)
    assert [env.taken for env in environments] == acted and returns == pytest.approx(wanted) and films == []
    assert len({len(actions) for actions in acted}) > 1 and len({a for actions in acted for a in actions}) == chosen


def test_every_environment_is_reset_once_an_evaluation_and_nothing_is_learnt():
    environments = [Choices() for _ in range(3)]
    net = network()
    before = {name: value.clone() for name, value in net.state_dict().items()}
    drawn = torch.get_rng_state()
    played = ConditionedEpisodes(environments, SPEC, seed=0)
    first = played.play(beginner(net))[0]
    assert [env.resets for env in environments] == [1, 1, 1] and all(env.done == STEPS for env in environments)
    assert played.play(beginner(net))[0].tolist() == first.tolist()
    assert [env.resets for env in environments] == [2, 2, 2]
    assert torch.equal(torch.get_rng_state(), drawn)
    assert all(torch.equal(value, before[name]) for name, value in net.state_dict().items())
    assert all(weight.grad is None for weight in net.parameters())


def test_what_is_asked_for_falls_by_what_was_got():
    net, play = network(), None
    env = Choices()
    seen, _ = env.reset(seed=0)
    asked = []
    plain = net.embed_returns
    net.embed_returns = lambda returns: asked.append(returns.tolist()) or plain(returns)
    play = Play(net, encode, episodes=2, target_return=3.0, temperature=1.0, seed=0)
    pictures = {VIEW: np.stack([np.repeat(seen, 2, 0)] * 2)}
    play.act(pictures)
    play.act(pictures, np.array([1.0, 0.0]))
    play.keep(np.array([1]))
    play.act({VIEW: pictures[VIEW][:1]}, np.array([0.5]))
    assert asked == [[3.0, 3.0], [2.0, 3.0], [2.5]]


def test_rewards_are_told_in_every_step_but_the_first():
    play = Play(network(), encode, episodes=1, target_return=3.0, temperature=1.0, seed=0)
    picture = {VIEW: np.zeros((2, 8, 8), np.uint8)}
    with pytest.raises(UserError, match="this step takes no rewards"):
        play.act(picture, 1.0)
    assert play.act(picture).shape == (1,)
    with pytest.raises(UserError, match="this step needs the rewards of the actions before"):
        play.act(picture)


def test_observations_and_rewards_of_other_episodes_are_refused():
    play = Play(network(), encode, episodes=3, target_return=3.0, temperature=1.0, seed=0)
    pictures = {VIEW: np.zeros((3, 2, 8, 8), np.uint8)}
    for count in (0, 2, 4):
        with pytest.raises(UserError, match=rf"^{count} observations were given, 3 episodes are played$"):
            play.act({VIEW: np.zeros((count, 2, 8, 8), np.uint8)})
    play.act(pictures)
    with pytest.raises(UserError, match=r"^rewards have shape \(2,\), expected \(3,\) or a number$"):
        play.act(pictures, np.zeros(2))
    assert play.act(pictures, 1.0).shape == (3,)


def test_actions_are_drawn_as_often_as_their_probability_says():
    play = Play(network(context=1), encode, episodes=4000, target_return=1.0, temperature=2.0, seed=0)
    logits = torch.tensor([2.0, 0.0, -2.0], dtype=torch.double).expand(4000, 3)
    counts = np.bincount(play._draw(logits), minlength=3) / 4000
    np.testing.assert_allclose(counts, torch.softmax(logits[0] / 2.0, -1), atol=0.025)
    play._temperature = 1e-310
    assert set(play._draw(logits).tolist()) == {0}
    assert set(play._draw(torch.tensor([[-1e9, 0.0, -1e9]]).double().expand(4000, 3)).tolist()) == {1}


def test_films_show_what_was_seen_at_first(monkeypatch):
    monkeypatch.setattr(evaluation, "FILMED_STEPS", 4)
    played = ConditionedEpisodes([Choices() for _ in range(3)], SPEC, seed=0)
    _, films = played.play(beginner(network()), 2)
    assert [film.shape for film in films] == [(4, 8, 8, 3)] * 2 and films[0].dtype == np.uint8
    env = Choices()
    seen, _ = env.reset(seed=np.random.default_rng(0).integers(2**31, size=3).tolist()[0])
    assert (films[0][0] == seen[0][..., None]).all()


@pytest.fixture
def games(monkeypatch):
    """Scores of games, without an emulator."""
    known = ModuleType("repdib_lightning.environments.atari_games")
    known.game_name = lambda game: game.lower()
    known.gamer_normalised = lambda game, score: 100 * (score - 2) / 28 if game == "breakout" else None
    monkeypatch.setitem(sys.modules, known.__name__, known)


def test_the_target_is_the_published_one_else_the_best_of_the_data(games):
    assert game_of(("repdib/Atari-v0", {"game": "Breakout"})) == "breakout"
    assert game_of(("CartPole-v1", {"game": "Breakout"})) == "" == game_of(None)
    targets = {game: asked_return(None, game, 7.0) for game in ("breakout", "seaquest", "qbert", "pong", "tennis", "")}
    assert list(targets.values()) == [90.0, 1150.0, 14000.0, 20.0, 7.0, 7.0]
    assert asked_return(0.0, "breakout", 7.0) == 0.0


def test_scores_are_those_of_a_gamer_where_they_are_known(games):
    returns = np.array([2.0, 30.0, 58.0])
    assert scores(returns, "breakout") == pytest.approx(
        {"return": 30.0, "return_deviation": returns.std(), "normalised": 100.0}
    )
    for game in ("tennis", ""):
        assert set(scores(returns, game)) == {"return", "return_deviation"}
