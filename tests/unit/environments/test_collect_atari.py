"""Recordings of Atari: the same bytes however made, games that are what they say, amid what they say."""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Callable
from dataclasses import replace
from itertools import islice
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from small_atari import write_small

from repdib_lightning.__main__ import main
from repdib_lightning.data.episodes import EpisodeStore
from repdib_lightning.data.fingerprint import recompute_fingerprint
from repdib_lightning.data.writer import EpisodeWriter
from repdib_lightning.environments import collect_atari as module
from repdib_lightning.environments.atari_env import AtariEnv
from repdib_lightning.environments.atari_recording import AtariFilm, AtariRecording, PlayedGame
from repdib_lightning.environments.collect_atari import collect_atari
from repdib_lightning.environments.numbered_clips import NumberedClips
from repdib_lightning.environments.side_image import SideImage
from repdib_lightning.errors import UserError

pytest.importorskip("ale_py")
pytest.importorskip("cv2")

SMALL: dict[str, Any] = {
    "samples": 900, "mixture": {"random": 0.5, "scripted-0.3": 0.5}, "image_size": 36, "side_width": 12, "seed": 5,
    "max_frames": 600, "progress": False,
}  # fmt: skip


@pytest.fixture(scope="module")
def path(tmp_path_factory) -> Path:
    return collect_atari(tmp_path_factory.mktemp("two") / "x.h5", workers=2, **SMALL)


@pytest.fixture(scope="module")
def store(path) -> EpisodeStore:
    return EpisodeStore(path)


def recording(**changed: Any) -> AtariRecording:
    """The recording of ``path``, or one with other options."""
    made = AtariRecording(
        "breakout", SMALL["samples"], SMALL["mixture"], 0.0, 4, 36, SMALL["max_frames"], "right", 12, "", 5
    )
    return replace(made, **changed)


def films(made: AtariRecording, numbers: range = range(3)) -> AtariFilm:
    play = made.open()
    return AtariFilm(made, [PlayedGame(number, **play(number)) for number in numbers])


def test_layout(store):
    assert store.contiguous and store.lengths.sum() == store.rows and (store.lengths - 1).sum() >= 900
    assert (store.lengths[:-1] - 1).sum() < 900 and store.lengths.max() <= 151
    assert {name: (spec.shape, spec.dtype) for name, spec in store.observations.items()} == {
        "frame": ((1, 36, 48), "uint8")
    }
    assert (store.actions_spec.kind, store.actions_spec.size) == ("discrete", 4)
    assert store.class_names == {"actions": ["NOOP", "FIRE", "RIGHT", "LEFT"]}
    kinds = {name: (factor.kind, factor.scale, factor.width) for name, factor in store.factors.items()}
    own = ("player_x", "ball_x", "ball_y", "lives", "bricks", "score")
    assert kinds == dict.fromkeys(own, ("endogenous", "continuous", 1)) | {
        "clip": ("exogenous", "categorical", 1), "background": ("exogenous", "continuous", 9),
    }  # fmt: skip
    assert store.attributes["environment"] == "atari"
    told = json.loads(store.attributes["configuration"])
    keys = {"game", "frame_skip", "sticky", "image_size", "side", "side_width", "side_source", "seed", "max_frames",
            "noop_max", "mixture", "samples", "policy", "policy_digest"}  # fmt: skip
    assert set(told) == keys and told["mixture"] == SMALL["mixture"] and told["game"] == "breakout"


def test_the_configuration_builds_the_environment_of_the_store(store):
    told = json.loads(store.attributes["configuration"])
    names = (
        "game",
        "frame_skip",
        "sticky",
        "image_size",
        "side",
        "side_width",
        "side_source",
        "max_frames",
        "noop_max",
    )
    env = AtariEnv(**{name: told[name] for name in names}, distractor_seed=told["seed"])
    assert env.observation_space.shape == store.observations["frame"].shape
    assert env.action_space.n == store.actions_spec.size
    image = int(store.array("factors/clip")[0])
    assert np.array_equal(env.side_image.image(image), store.array("observations/frame")[0, 0, :, 36:])


def test_playing_the_stored_actions_leads_to_the_stored_rows(store):
    made = recording()
    numbers = recorded_numbers(store, made)
    for episode in (0, len(store.lengths) - 1):
        rows = store.starts[episode] + np.arange(store.lengths[episode])
        game = made.console()
        game.reset(made.chance(numbers[episode], 0), made.chance(numbers[episode], 1))
        actions, rewards = store.gather("actions", rows), store.gather("rewards", rows)
        frames = store.gather("observations/frame", rows)
        for row in range(len(rows)):
            assert np.array_equal(game.picture(), frames[row, 0, :, :36])
            assert store.gather("factors/player_x", rows)[row] == game.ram()[72]
            if row < len(rows) - 1:
                assert game.step(int(actions[row])) == rewards[row]
        last = [bool(store.gather(key, rows)[-2]) for key in ("terminations", "truncations")]
        assert last == [game.over, game.truncated] and actions[-1] == -1
        score = store.gather("factors/score", rows)
        assert np.array_equal(np.diff(score), rewards[:-1])


def recorded_numbers(store: EpisodeStore, made: AtariRecording) -> list[int]:
    """Of the games of the store, found by their actions."""
    play = made.open()
    known = {play(number)["actions"].tobytes(): number for number in range(2 * len(store.lengths))}
    stored = np.array(store.array("actions")).astype(np.uint8)
    ends = store.starts + store.lengths - 1
    return [known[stored[start:end].tobytes()] for start, end in zip(store.starts, ends, strict=True)]


def test_both_play_their_share_and_the_script_plays_better(store):
    made = recording()
    numbers = recorded_numbers(store, made)
    lengths = store.lengths - 1
    shares = [sum(lengths[i] for i, n in enumerate(numbers) if made.who(n) == who) for who in made.players]
    assert min(shares) / sum(shares) > 0.4
    assert len(set(numbers)) == len(numbers)
    scores = {who: [] for who in made.players}
    rewards = np.array(store.array("rewards"))
    for start, length, number in zip(store.starts, lengths, numbers, strict=True):
        scores[made.who(number)].append(rewards[start : start + length].sum())
    assert np.mean(scores["scripted-0.3"]) > np.mean(scores["random"])


def test_ends_are_where_games_end(store):
    last = store.starts + store.lengths - 2
    over, cut = (np.flatnonzero(np.array(store.array(key))) for key in ("terminations", "truncations"))
    assert np.array_equal(np.sort(np.concatenate([over, cut])), last) and len(cut) and len(over)
    assert (store.lengths[np.isin(last, cut)] >= 141).all()  # 600 frames, up to 30 of them no-ops, 4 a step


def test_held_out_episodes_show_held_out_images(store):
    held_out = store.evaluation[store.row_episodes]
    clips = np.array(store.array("factors/clip"))
    assert store.evaluation.any() and not store.evaluation.all()
    assert set(clips[held_out]) <= set(range(1000, 1004)) and set(clips[~held_out]) <= set(range(1000))
    assert np.array_equal(clips, np.repeat(clips[store.starts], store.lengths)) and len(set(clips)) > 3
    pool = SideImage("right", 12, "", 5, 36)
    for start in store.starts:
        shown = store.array("observations/frame")[start, 0, :, 36:]
        assert np.array_equal(shown, pool.image(int(clips[start])))
        assert np.allclose(store.array("factors/background")[start], pool.factors(int(clips[start]))["background"])


def test_games_of_all_players_are_held_out():
    mixture = {"random": 0.1, "scripted-0.02": 0.2, "scripted-0.1": 0.3, "scripted-0.3": 0.4}
    made = recording(mixture=mixture)
    games = [PlayedGame(4 * turn + who, np.zeros(1, np.uint8), np.zeros(1, np.float32))
             for turn in range(40) for who in range(4) if turn < (10, 20, 30, 40)[who]]  # fmt: skip
    held_out = AtariFilm(made, games).evaluation_episodes
    by_player = [sum(games[episode].number % 4 == who for episode in held_out) for who in range(4)]
    assert by_player == [1, 2, 3, 4]


def test_games_are_the_same_amid_any_image():
    looks: list[dict[str, Any]] = [{}, {"side": "none"}, {"side": "top", "side_width": 20}, {"image_size": 50}]
    filmed = []
    for look in looks:
        film = films(recording(max_frames=200, **look), range(1))
        filmed.append(film.open()(0))
    for episode in filmed[1:]:
        for key in ("actions", "rewards", "terminations"):
            assert np.array_equal(episode[key], filmed[0][key])
        assert np.array_equal(episode["factors"]["ball_x"], filmed[0]["factors"]["ball_x"])
    assert np.array_equal(filmed[1]["observations"]["frame"], filmed[0]["observations"]["frame"][..., :36])
    assert "clip" not in filmed[1]["factors"] and filmed[2]["observations"]["frame"].shape[2:] == (56, 36)


def test_sticky_games_are_filmed_as_they_were_played():
    made = recording(sticky=0.25, max_frames=400)
    film = films(made, range(2))
    for episode in range(2):
        assert np.array_equal(film.open()(episode)["rewards"], film.games[episode].rewards)
    plain = films(recording(max_frames=400), range(2))
    assert not np.array_equal(plain.games[1].actions, film.games[1].actions)  # the script saw another game


def test_a_game_that_goes_another_way_is_not_stored():
    film = films(recording(), range(2))
    longer = PlayedGame(1, np.full(len(film.games[1].actions), 1, np.uint8), film.games[1].rewards + 1)
    with pytest.raises(AssertionError, match="went another way"):
        AtariFilm(film.recording, [longer]).open()(0)


def test_one_worker_that_is_interrupted_and_goes_on_makes_the_same_bytes(path, tmp_path, monkeypatch, capsys):
    add, added = EpisodeWriter.add_episode, []

    def interrupted(self: EpisodeWriter, **episode: Any) -> None:
        if len(added) == 2:
            raise KeyboardInterrupt
        added.append(1)
        add(self, **episode)

    monkeypatch.setattr(EpisodeWriter, "add_episode", interrupted)
    with pytest.raises(KeyboardInterrupt):
        collect_atari(tmp_path / "x.h5", workers=1, **SMALL)
    monkeypatch.undo()
    assert os.listdir(tmp_path) == [".x.h5.partial"]
    with h5py.File(tmp_path / ".x.h5.partial", locking=False) as file:
        assert np.count_nonzero(file["episodes/length"]) == 2
    monkeypatch.setattr(module, "recorded_in_order", in_this_process)
    with pytest.raises(UserError, match=r"an unfinished recording with other options: side_width was 12, is 14"):
        collect_atari(tmp_path / "x.h5", workers=1, **SMALL | {"side_width": 14})
    collect_atari(tmp_path / "x.h5", workers=1, **SMALL | {"progress": True})
    told = capsys.readouterr().err
    assert "breakout: random played " in told and "breakout: scripted-0.3 played " in told
    assert (tmp_path / "x.h5").read_bytes() == path.read_bytes() and os.listdir(tmp_path) == ["x.h5"]
    assert recompute_fingerprint(EpisodeStore(tmp_path / "x.h5")) == EpisodeStore(path).fingerprint


def in_this_process(made: Any, episodes: Any, workers: int) -> Any:
    """As ``recorded_in_order``, without workers."""
    record = made.open()
    for episode in islice(iter(episodes), len(episodes)):
        yield record(episode)


@pytest.fixture
def at_once(monkeypatch) -> None:
    monkeypatch.setattr(module, "recorded_in_order", in_this_process)


def test_networks_of_several_ages_play(tmp_path, at_once):
    policy = write_small(tmp_path / "p.safetensors")
    options = SMALL | {"samples": 150, "max_frames": 200, "side": "none", "policy": policy}
    made = EpisodeStore(collect_atari(tmp_path / "x.h5", **options | {"mixture": {"dqn": 0.5, "dqn-30": 0.5}}))
    told = json.loads(made.attributes["configuration"])
    assert told["policy"] == "p.safetensors" and len(told["policy_digest"]) == 16
    assert made.observations["frame"].shape == (1, 36, 36) and "clip" not in made.factors
    default = EpisodeStore(collect_atari(tmp_path / "y.h5", **options | {"mixture": None}))
    assert json.loads(default.attributes["configuration"])["mixture"] == {
        "dqn-30": 0.45,
        "dqn-400": 0.45,
        "random": 0.1,
    }


def test_a_game_without_a_table_of_variables_has_the_image_as_its_only_factors(tmp_path, at_once):
    made = EpisodeStore(
        collect_atari(
            tmp_path / "x.h5", **SMALL | {"game": "Tennis", "mixture": None, "samples": 60, "max_frames": 200}
        )
    )
    assert set(made.factors) == {"clip", "background"} and made.actions_spec.size == 18
    assert json.loads(made.attributes["configuration"])["mixture"] == {"random": 1.0}


def test_the_order_in_which_players_are_named_changes_nothing(tmp_path, at_once):
    options = SMALL | {"samples": 200, "max_frames": 200}
    made = [
        collect_atari(tmp_path / f"{i}.h5", **options | {"mixture": mixture}).read_bytes()
        for i, mixture in enumerate(({"random": 0.4, "scripted-0.1": 0.6}, {"scripted-0.1": 0.6, "random": 0.4}))
    ]
    assert made[0] == made[1]


def test_pictures_of_a_folder_are_shown(tmp_path, at_once):
    from PIL import Image

    (tmp_path / "pictures").mkdir()
    for number in range(8):
        pixels = np.random.default_rng(number).integers(256, size=(40, 20, 3), dtype=np.uint8)
        Image.fromarray(pixels).save(tmp_path / "pictures" / f"{number}.png")
    source = str(tmp_path / "pictures")
    options = SMALL | {"samples": 100, "max_frames": 200, "side": "left", "side_source": source}
    made = EpisodeStore(collect_atari(tmp_path / "x.h5", **options))
    assert made.factors["clip"].classes == 8
    clip = NumberedClips(source, 5, size=(36, 12)).clip(int(made.array("factors/clip")[0]))[0]
    grey = made.array("observations/frame")[0, 0, :, :12].astype(float)
    assert np.abs(grey - clip @ np.array([0.299, 0.587, 0.114])).max() <= 0.51


@pytest.fixture
def complain(tmp_path, monkeypatch, capsys) -> Callable[..., str]:
    """Run ``collect atari``, which must fail; return its one line."""
    monkeypatch.chdir(tmp_path)

    def run(*options: str) -> str:
        before = sorted(os.listdir())
        assert main(["collect", "atari", "x.h5", "--progress", "false", *options]) == 2
        error = capsys.readouterr().err.splitlines()
        assert len(error) == 1 and sorted(os.listdir()) == before
        return error[0]

    return run


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["--game", "Breakot"], "game=Breakot: unknown, did you mean 'breakout'?"),
        (["--samples", "0"], "samples=0: must be at least 1"),
        (["--workers", "0"], "workers=0: must be at least 1"),
        (["--seed", "-1"], "seed=-1: must be at least 0"),
        (["--sticky", "1"], "sticky=1.0: must be at least 0 and below 1"),
        (["--image_size", "8"], "image_size=8: must be from 16 to 210"),
        (["--side", "rigt"], "side: unknown 'rigt', did you mean 'right'?"),
        (["--side_width", "2"], "side_width=2: must be from 3 to 512"),
        (["--side_source", "nowhere"], "side_source=nowhere: 'nowhere' is neither built in nor"),
        (["--side", "none", "--side_source", "x"], "side_source=x: means nothing with side=none"),
        (["--mixture", "{random: 0.2, scripted-0.3: 0.4}"], "mixture: the rates sum to 0.6, must sum to 1"),
        (["--mixture", "{randm: 1}"], "mixture: unknown player 'randm', did you mean 'random'?"),
        (["--game", "tennis", "--mixture", "{scripted-0.1: 1}"], "mixture: scripted-0.1: no script plays tennis; "),
        (["--mixture", "{dqn: 1}"], "mixture: dqn needs --policy"),
        (["--policy", "nowhere.safetensors"], "--policy nowhere.safetensors: no such file"),
        (["--mixtur", "{random: 1}"], "unknown option --mixtur, did you mean '--mixture'?"),
    ],
)
def test_bad_options_are_one_line_with_the_nearest_choice(complain, options, said):
    assert said in complain(*options)


def test_a_policy_of_another_game_and_a_file_that_is_there_are_refused_before_anything_is_played(
    complain, tmp_path, monkeypatch
):
    def nothing(*_: Any) -> None:
        raise AssertionError("played")

    monkeypatch.setattr(module, "recorded_in_order", nothing)
    write_small(tmp_path / "p.safetensors")
    size = ["--image_size", "36"]
    said = complain("--policy", "p.safetensors", "--game", "pong", *size)
    assert "--policy p.safetensors: was trained with game=breakout, this recording has pong" in said
    said = complain("--policy", "p.safetensors", "--mixture", "{random: 1}", *size)
    assert "--policy p.safetensors: nobody of the mixture plays it; name dqn or dqn-400" in said
    Path("x.h5").write_text("mine")
    assert "x.h5: exists already" in complain() and Path("x.h5").read_text() == "mine"


@pytest.mark.parametrize("missing", ["ale_py", "cv2"])
def test_what_is_not_installed_is_one_line(complain, missing, monkeypatch):
    monkeypatch.setitem(sys.modules, missing, None)
    assert "Atari games need ale-py and opencv: pip install 'repdib_lightning[atari]'" in complain()
