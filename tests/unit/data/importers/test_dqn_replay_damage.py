"""DQN-replay logs that cannot be imported: one line names the file, and nothing is left behind."""

from __future__ import annotations

import gzip
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from dqn_replay_tree import array_file, play, write_array, write_checkpoint

from repdib_lightning.data.episodes import EpisodeStore
from repdib_lightning.data.importers.dqn_replay import import_dqn_replay
from repdib_lightning.errors import UserError

ARRAYS = ("observation", "action", "reward", "terminal")


@pytest.fixture
def logs(tmp_path: Path) -> Path:
    """Two checkpoints of eight episodes of 13 rows."""
    folder = tmp_path / "Breakout" / "1" / "replay_logs"
    for number in (0, 3):
        write_checkpoint(folder, number, play([10] * 8, seed=number))
    return folder


def refuse(source: Path, *words: str, **options: Any) -> None:
    """One line that holds every word, and no file left in the output's folder."""
    output = source.parents[2] / "out" / "store.h5"
    with pytest.raises(UserError) as caught:
        import_dqn_replay(source, output, **{"selection": "all", "progress": False, **options})
    message = str(caught.value)
    assert "\n" not in message
    for word in words:
        assert word in message, message
    assert not output.parent.exists() or not list(output.parent.iterdir())


def rewrite(logs: Path, name: str, change: Callable[[np.ndarray], np.ndarray]) -> str:
    """Change an array of checkpoint 3; returns the file's name."""
    path = array_file(logs, name, 3)
    with gzip.open(path) as file:
        array = np.load(file)
    write_array(path, change(array))
    return path.name


@pytest.mark.parametrize("name", ARRAYS)
def test_a_missing_array(logs: Path, name: str) -> None:
    array_file(logs, name, 3).unlink()
    refuse(logs, f"$store$_{name}_ckpt.3.gz", "missing", "checkpoint 3")
    output = logs.parents[2] / "store.h5"
    import_dqn_replay(logs, output, selection="all", checkpoints=[0], progress=False)
    assert len(EpisodeStore(output).starts) == 8


@pytest.mark.parametrize("name", ARRAYS)
def test_a_truncated_file(logs: Path, name: str) -> None:
    path = array_file(logs, name, 3)
    path.write_bytes(path.read_bytes()[:-9])
    refuse(logs, path.name, "truncated", "get it again")


def test_truncated_frames_name_the_row(logs: Path) -> None:
    path = array_file(logs, "observation", 3)
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    refuse(logs, path.name, "truncated", "of 104 rows")


@pytest.mark.parametrize("name", ARRAYS)
def test_an_array_that_is_shorter_than_it_says(logs: Path, name: str) -> None:
    path = array_file(logs, name, 3)
    whole = gzip.decompress(path.read_bytes())
    path.write_bytes(gzip.compress(whole[:-300] if name == "observation" else whole[:-8]))
    refuse(logs, path.name, "truncated", "of 104 rows")


@pytest.mark.parametrize("name", ARRAYS)
def test_what_is_no_gzip_file(logs: Path, name: str) -> None:
    path = array_file(logs, name, 3)
    path.write_text("<html>quota exceeded</html>")
    refuse(logs, path.name, "is not a gzip file")


@pytest.mark.parametrize("name", ARRAYS)
def test_what_is_no_array(logs: Path, name: str) -> None:
    path = array_file(logs, name, 3)
    path.write_bytes(gzip.compress(b"\x80\x04 a pickle, as add_count once was"))
    refuse(logs, path.name, "holds no .npy array")


@pytest.mark.parametrize("name", ARRAYS)
def test_an_empty_file(logs: Path, name: str) -> None:
    path = array_file(logs, name, 3)
    path.write_bytes(b"")
    refuse(logs, path.name, "is empty")


@pytest.mark.parametrize("name", ARRAYS)
def test_damaged_content(logs: Path, name: str) -> None:
    path = array_file(logs, name, 3)
    content = bytearray(path.read_bytes())
    middle = len(content) // 2
    content[middle : middle + 20] = bytes(20)
    path.write_bytes(content)
    refuse(logs, path.name)


@pytest.mark.parametrize(
    ("name", "change", "words"),
    [
        ("observation", lambda frames: frames / np.float32(255), ("float32", "must be uint8")),
        ("observation", lambda frames: frames[:, None], ("(104, 1, 10, 10)", "un-stacked")),
        ("observation", lambda frames: frames[:, :, 1:], ("(104, 10, 9)", "(n, 84, 84)")),
        ("observation", lambda frames: frames[:, 1:, 1:], ("9 x 9 pixels", "ckpt.0.gz has 10 x 10")),
        ("observation", np.asfortranarray, ("column by column",)),
        ("action", lambda actions: actions.astype(np.float32), ("float32", "must be whole numbers")),
        ("action", lambda actions: actions[:, None], ("(104, 1)", "must be (n,)")),
        ("reward", lambda rewards: rewards.astype(np.int64), ("int64", "must be floating point")),
        ("reward", lambda rewards: np.stack([rewards, rewards], 1), ("(104, 2)", "must be (n,)")),
        ("terminal", lambda ends: ends.astype(np.float32), ("float32", "must be whole numbers")),
        ("terminal", lambda ends: ends * np.uint8(7), ("is 7 at row 12", "must be 0 or 1")),
    ],
)
def test_another_type_or_shape(logs: Path, name: str, change: Any, words: tuple[str, ...]) -> None:
    refuse(logs, rewrite(logs, name, change), *words)


@pytest.mark.parametrize("name", ARRAYS[1:])
def test_lengths_that_disagree(logs: Path, name: str) -> None:
    file = rewrite(logs, name, lambda array: array[:-2])
    refuse(logs, file, "has 102 rows", "$store$_observation_ckpt.3.gz has 104")


@pytest.mark.parametrize(("action", "shown"), [(4, "is 4"), (-1, "is -1")])
def test_an_action_that_the_game_lacks(logs: Path, action: int, shown: str) -> None:
    def change(actions: np.ndarray) -> np.ndarray:
        actions[20] = action
        return actions

    refuse(logs, rewrite(logs, "action", change), shown, "row 20", "0 to 3 (NOOP, FIRE, RIGHT, LEFT)")


@pytest.mark.parametrize("reward", [np.nan, np.inf])
def test_rewards_that_are_not_finite(logs: Path, reward: float) -> None:
    def change(rewards: np.ndarray) -> np.ndarray:
        rewards[30] = reward
        return rewards

    refuse(logs, rewrite(logs, "reward", change), f"is {reward} at row 30", "must be finite")


@pytest.mark.parametrize("name", ["observation", "action", "reward"])
def test_an_episode_without_the_padding_of_the_others(logs: Path, name: str) -> None:
    def change(array: np.ndarray) -> np.ndarray:
        array[27] = 1
        return array

    rewrite(logs, name, change)
    refuse(logs, "$store$_observation_ckpt.3.gz", "row 26", "--padding keep")
    output = logs.parents[2] / "store.h5"
    import_dqn_replay(logs, output, selection="all", padding="keep", progress=False)
    assert EpisodeStore(output).rows == 2 * 8 * 14


def test_an_episode_without_end_is_not_taken_into_memory(tmp_path: Path) -> None:
    logs = tmp_path / "Breakout" / "1" / "replay_logs"
    rows = play([30_000], size=1)
    write_checkpoint(logs, 0, rows)
    refuse(logs, "$store$_terminal_ckpt.0.gz", "no end in rows 0 to 30,001", "27,003")
    rows["terminal"][-1] = 0
    write_checkpoint(logs, 0, rows)
    refuse(logs, "no episode ends", "--partial keep")
    refuse(logs, "27,003", partial="keep")


def test_nothing_to_import(logs: Path, tmp_path: Path) -> None:
    refuse(tmp_path / "a" / "b" / "c", "c: no such file or folder")
    refuse(logs / "$store$_action_ckpt.0.gz", "is a file", f"name its folder, {logs}")
    refuse(tmp_path, f"did you mean {logs}?")
    refuse(logs.parents[1], f"did you mean {logs}?")
    other = tmp_path / "other" / "1" / "replay_logs"
    other.mkdir(parents=True)
    refuse(other.parent, "$store$_observation_ckpt.N.gz")
    refuse(logs.parent / "nothing", "no such file")
    other.rmdir()
    refuse(other.parent, "<Game>/<run>/replay_logs")


def test_unknown_checkpoints(logs: Path) -> None:
    write_checkpoint(logs, 1, play([10]))
    refuse(logs, "checkpoints=7", "there are 0-1, 3", checkpoints=[0, 7])
    refuse(logs, "checkpoints=[]", "there are 0-1, 3", checkpoints=[])


def test_unknown_games(logs: Path) -> None:
    refuse(logs, "game=Breakot", "breakout", game="Breakot")
    renamed = logs.parents[1].rename(logs.parents[2] / "downloads")
    refuse(renamed / "1" / "replay_logs", "downloads: is not named after a game", "--game")


@pytest.mark.parametrize(
    ("option", "value", "word"),
    [
        ("selection", "decision_tranformer", "did you mean 'decision_transformer'"),
        ("partial", "cut", "keep"),
        ("padding", "cut", "keep"),
        ("transitions", 0, "at least 1"),
        ("per_visit", 0, "at least 1"),
        ("read_up_to", 0, "at least 1"),
        ("seed", -1, "at least 0"),
        ("seed", 2**32, "below"),
        ("side", "up", "top"),
        ("side_width", 1, "from 3"),
    ],
)
def test_options_out_of_range(logs: Path, option: str, value: Any, word: str) -> None:
    refuse(logs, f"{option}={value}", word, **{option: value})


def test_no_visit_fits(logs: Path) -> None:
    refuse(logs, "11 episodes", "row 100,000", "--per_visit", "--partial keep", selection="decision_transformer")


def test_a_broken_add_count(logs: Path) -> None:
    write_array(logs / "add_count_ckpt.3.gz", np.arange(2.0))
    refuse(logs, "add_count_ckpt.3.gz", "one whole number")


def test_an_existing_output_is_kept_unless_overwritten(logs: Path, tmp_path: Path) -> None:
    output = tmp_path / "store.h5"
    output.write_text("mine")
    with pytest.raises(UserError, match="exists already"):
        import_dqn_replay(logs, output, selection="all", progress=False)
    assert output.read_text() == "mine"
    import_dqn_replay(logs, output, selection="all", overwrite=True, progress=False)
    assert len(EpisodeStore(output).starts) == 16
