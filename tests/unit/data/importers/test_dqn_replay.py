"""DQN-replay logs: what is selected, every value of it arrives, and the rest is counted."""

from __future__ import annotations

import gzip
import json
import tracemalloc
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from dqn_replay_tree import (
    ACTIONS,
    SIZE,
    Rows,
    array_file,
    log_as_dopamine,
    play,
    read_all,
    write_array,
    write_checkpoint,
)

from repdib_lightning.data.episodes import EpisodeStore
from repdib_lightning.data.fingerprint import recompute_fingerprint
from repdib_lightning.data.importers import dqn_replay_arrays
from repdib_lightning.data.importers.dqn_replay import import_dqn_replay
from repdib_lightning.data.importers.dqn_replay_selection import Ends, decision_transformer
from repdib_lightning.environments.numbered_clips import NumberedClips
from repdib_lightning.environments.side_image import SideImage

Place = tuple[int, int, int]  # checkpoint, first row, row behind the last


@pytest.fixture
def logs(tmp_path: Path) -> Path:
    return tmp_path / "Breakout" / "1" / "replay_logs"


def load(logs: Path, **options: Any) -> EpisodeStore:
    output = logs.parents[2] / "out" / "store.h5"
    return EpisodeStore(import_dqn_replay(logs, output, **{"progress": False, "overwrite": True, **options}))


def left_out(store: EpisodeStore) -> dict[str, int]:
    return {name: count for name, count in json.loads(str(store.attributes["left_out"])).items() if count}


def check_whole_episodes(store: EpisodeStore, logs: Path, places: list[Place]) -> None:
    """The store holds these rows of the log, without padding, each place an episode that ended."""
    assert len(store.starts) == len(places)
    for start, length, (number, first, stop) in zip(store.starts, store.lengths, sorted(places), strict=True):
        rows = read_all(logs, number)
        seen = rows["observation"][first:stop].any((1, 2)).argmax()
        expected = {name: array[first + seen : stop] for name, array in rows.items()}
        assert length == len(expected["action"]) + 1
        frames = store.array("observations/frame")[start : start + length]
        np.testing.assert_array_equal(frames[:-1, 0], expected["observation"])
        np.testing.assert_array_equal(frames[-1], frames[-2])
        actions = slice(start, start + length - 1)
        np.testing.assert_array_equal(store.array("actions")[actions], expected["action"])
        np.testing.assert_array_equal(store.array("rewards")[actions], expected["reward"])
        np.testing.assert_array_equal(store.array("terminations")[actions], expected["terminal"])
    assert not np.any(store.array("truncations"))


def walk(logs: Path, numbers: list[int], transitions: int, per_visit: int, read_up_to: int, seed: int) -> list[Place]:
    """The selection of the Decision Transformer, row by row as in its published code."""
    terminals = {number: read_all(logs, number)["terminal"] for number in numbers}
    random = np.random.RandomState(seed)
    reached = dict.fromkeys(numbers, 0)
    taken: list[Place] = []
    total = 0
    for _ in range(1000):
        if total >= transitions:
            return taken
        number = int(random.choice(numbers, 1)[0])
        row, left, visit, finished = reached[number], per_visit, [], False
        first = row
        while not finished:
            if terminals[number][row]:
                visit.append((number, first, row + 1))
                first = row + 1
                finished = left == 0
                left -= 1
            row += 1
            if row >= read_up_to:
                visit, row, finished = [], reached[number], True
        taken += visit
        total += sum(stop - first for _, first, stop in visit)
        reached[number] = row
    return taken


@pytest.mark.parametrize("padded", [True, False])
@pytest.mark.parametrize("seed", [0, 1, 2])
def test_selection_of_the_decision_transformer(logs: Path, seed: int, padded: bool) -> None:
    lengths = np.random.default_rng(seed).integers(5, 40, 120).tolist()
    count = log_as_dopamine(logs, play(lengths, padded=padded, seed=seed), capacity=450)
    chosen = {"transitions": 700, "per_visit": 3, "read_up_to": 300, "seed": seed}
    places = walk(logs, list(range(count)), **chosen)
    assert sum(stop - first for _, first, stop in places) >= 700
    assert len({number for number, _, _ in places}) > 2
    check_whole_episodes(load(logs, **chosen), logs, places)


def test_draws_are_those_of_the_global_generator() -> None:
    ends = Ends(100_000, np.arange(199, 100_000, 200))
    drawn = decision_transformer(
        lambda number: ends, range(50), transitions=100_000, per_visit=10, read_up_to=100_000, seed=123, keep=False
    )
    np.random.seed(123)  # noqa: NPY002, as the published code does
    visits = [np.random.choice(np.arange(50), 1)[0] for _ in range(46)]  # noqa: NPY002
    assert [piece.checkpoint for piece in drawn.pieces[::11]] == visits
    assert drawn.logged == 46 * 11 * 200


def test_a_visit_that_would_pass_the_last_row_is_given_up_whole(logs: Path, capsys: pytest.CaptureFixture) -> None:
    write_checkpoint(logs, 0, play([17] * 20))  # rows 0-19 are the first episode
    store = load(logs, transitions=10_000, per_visit=2, read_up_to=179)
    check_whole_episodes(store, logs, [(0, first, first + 20) for first in range(0, 120, 20)])
    assert left_out(store) == {"padding": 18, "given_up": 1, "given_up_rows": 59}
    told = capsys.readouterr().err
    assert "102 transitions of breakout in 6 episodes of checkpoints 0" in told
    assert "what visits left of 1 checkpoints (59 rows)" in told
    assert "there are 120 of 10,000" in told


@pytest.mark.parametrize(("read_up_to", "episodes"), [(60, 0), (61, 3)])
def test_the_last_row_to_be_read_is_not_reached(logs: Path, read_up_to: int, episodes: int) -> None:
    terminals = np.arange(19, 200, 20)
    drawn = decision_transformer(
        lambda number: Ends(200, terminals), [0], transitions=99, per_visit=2, read_up_to=read_up_to, seed=0, keep=False
    )
    assert len(drawn.pieces) == episodes


def test_kept_pieces_end_where_reading_ends(logs: Path) -> None:
    write_checkpoint(logs, 0, play([17] * 20))
    store = load(logs, transitions=10_000, per_visit=2, read_up_to=170, partial="keep")
    assert store.lengths.tolist() == [18] * 8 + [7]  # of 10 rows 3 are padding, 7 frames hold 6 actions
    rows = read_all(logs, 0)
    np.testing.assert_array_equal(store.array("observations/frame")[-7:, 0], rows["observation"][163:170])
    np.testing.assert_array_equal(store.array("actions")[-7:-1], rows["action"][163:169])
    assert np.flatnonzero(store.array("truncations")).tolist() == [store.rows - 2]
    assert np.flatnonzero(store.array("terminations")).tolist() == [18 * n + 16 for n in range(8)]
    assert left_out(store) == {"padding": 27}


def whole_run(rows: Rows) -> np.ndarray:
    return rows["observation"][rows["observation"].any((1, 2))]


def test_all_takes_every_row_of_a_ring_once(logs: Path, capsys: pytest.CaptureFixture) -> None:
    rows = play([30, 12, 25, 8, 40, 20, 33, 21])
    assert log_as_dopamine(logs, rows, capacity=100) == 2
    store = load(logs, selection="all", partial="keep")
    frames, last = store.array("observations/frame"), store.starts + store.lengths - 1
    repeated = np.zeros(store.rows, bool)
    repeated[last] = store.array("terminations")[last - 1]
    run = np.delete(whole_run({"observation": rows["observation"][:199]}), 99 - 3 * 5, axis=0)  # row 99 is in no log
    np.testing.assert_array_equal(frames[~repeated][:, 0], run)
    assert left_out(store)["older"] == 2
    assert "1 begin in mid-episode" in capsys.readouterr().err


def test_pieces_without_an_end_are_left_out_and_counted(logs: Path, capsys: pytest.CaptureFixture) -> None:
    rows = play([30, 12, 25, 8, 40, 20, 33, 21])
    log_as_dopamine(logs, rows, capacity=100)
    store = load(logs, selection="all")
    ends = [np.flatnonzero(read_all(logs, number)["terminal"][:99] == 1) + 1 for number in (0, 1)]
    places = [(n, a, b) for n in (0, 1) for a, b in zip([0, *ends[n]], ends[n], strict=False)]
    check_whole_episodes(store, logs, places)
    rest = [99 - int(stops[-1]) for stops in ends]
    assert left_out(store) == {"padding": 3 * 6, "without_end": 2, "without_end_rows": sum(rest), "older": 2}
    assert f"2 pieces without an end ({sum(rest)} rows)" in capsys.readouterr().err


def test_first_takes_whole_episodes_in_numeric_order(logs: Path) -> None:
    for number in (10, 2, 3):
        write_checkpoint(logs, number, play([10] * 4, seed=number))
    store = load(logs, selection="first", transitions=60)
    check_whole_episodes(store, logs, [(2, n * 13, n * 13 + 13) for n in range(4)] + [(3, 0, 13)])
    assert left_out(store) == {"padding": 15}
    assert json.loads(str(store.attributes["configuration"]))["checkpoints"] == [2, 3]
    again = load(logs, selection="first", transitions=14, checkpoints=[10, 3])
    check_whole_episodes(again, logs, [(3, 0, 13), (3, 13, 26)])


def test_a_checkpoint_may_begin_within_padding(logs: Path) -> None:
    rows = play([9, 9, 9])
    write_checkpoint(logs, 4, {name: array[1:] for name, array in rows.items()})
    store = load(logs, selection="all")
    assert store.lengths.tolist() == [10, 10, 10]
    assert left_out(store) == {"padding": 8}
    kept = load(logs, selection="all", padding="keep")
    assert kept.lengths.tolist() == [12, 13, 13]
    assert not kept.array("observations/frame")[:2].any()


@pytest.mark.parametrize("played", ["action", "reward"])
def test_a_game_that_begins_in_black_is_no_padding(logs: Path, played: str) -> None:
    rows = play([9, 9, 9], padded=False)
    for first in (0, 9, 18):
        for name in ("observation", "action", "reward"):
            rows[name][first : first + 3] = 0
        rows[played][first + 2] = 1
    write_checkpoint(logs, 1, rows)
    store = load(logs, selection="all")
    assert store.lengths.tolist() == [10, 10, 10] and not left_out(store)


def test_frames_after_the_last_one_needed_are_never_read(logs: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_checkpoint(logs, 0, play([97] * 10))
    path = array_file(logs, "observation", 0)
    content = path.read_bytes()
    path.write_bytes(content[: len(content) * 6 // 10])
    read = 0

    class Counting(gzip.GzipFile):
        def read(self, size: int | None = -1) -> bytes:
            nonlocal read
            part = super().read(size)
            read += len(part) if self.name == str(path) else 0
            return part

    monkeypatch.setattr(dqn_replay_arrays.gzip, "open", Counting)
    store = load(logs, selection="first", transitions=500)
    assert len(store.starts) == 5
    once = 500 * SIZE * SIZE
    assert once <= read < once + 120 * SIZE * SIZE  # and up to the second episode, to see whether there is padding


def test_memory_holds_one_episode(logs: Path) -> None:
    rows = 29_000
    write_checkpoint(
        logs,
        0,
        {
            "action": np.ones(rows, np.int32),
            "reward": np.zeros(rows, np.float32),
            "terminal": (np.arange(rows) % 500 == 499).astype(np.uint8),
        },
    )
    write_array(array_file(logs, "observation", 0), np.zeros((rows, 84, 84), np.uint8))  # 205 MB
    tracemalloc.start()
    try:
        store = load(logs, selection="first", transitions=500, side="right")
        few = tracemalloc.get_traced_memory()[1]
        tracemalloc.reset_peak()
        store = load(logs, selection="all", side="right")
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert store.rows == rows + rows // 500
    assert peak < 24 * 2**20
    assert peak < few + 2**20


def test_an_image_on_the_side(logs: Path) -> None:
    write_checkpoint(logs, 0, play([6] * 60))
    plain = load(logs, selection="all").array("observations/frame")[:].copy()
    store = load(logs, selection="all", side="right", side_width=5, seed=3)
    images = SideImage("right", 5, "", 3, SIZE)
    frames, clips = store.array("observations/frame"), store.array("factors/clip")
    assert frames.shape[1:] == (1, SIZE, SIZE + 5)
    np.testing.assert_array_equal(frames[..., :SIZE], plain)
    pool = NumberedClips("procedural_images", 3, size=(SIZE, 5))
    shown: dict[bool, set[int]] = {True: set(), False: set()}
    for start, length, held_out in zip(store.starts, store.lengths, store.evaluation, strict=True):
        clip = int(clips[start])
        assert (clips[start : start + length] == clip).all()
        shown[bool(held_out)].add(clip)
        for row in range(start, start + length):
            np.testing.assert_array_equal(frames[row, 0, :, SIZE:], images.image(clip))
            np.testing.assert_array_equal(store.array("factors/background")[row], images.factors(clip)["background"])
    assert np.flatnonzero(store.evaluation).tolist() == [5, 15, 25, 35, 45, 55]
    assert all(shown[held_out] <= set(pool.numbers(held_out).tolist()) for held_out in (True, False))
    assert len(shown[False]) > 10 and len(shown[True]) > 1
    assert recompute_fingerprint(store) == store.fingerprint


def test_attributes_say_how_to_evaluate_and_how_it_was_made(logs: Path) -> None:
    write_checkpoint(logs, 0, play([6] * 6))
    store = load(logs, selection="first", transitions=30, side="left", side_width=4, seed=2)
    configuration = json.loads(str(store.attributes["configuration"]))
    assert store.attributes["environment"] == "atari"
    expected = {"game": "breakout", "frame_skip": 4, "sticky": 0.0, "recorded_sticky": 0.25, "image_size": SIZE}
    expected |= {"side": "left", "side_width": 4, "side_source": "", "seed": 2}
    expected |= {"selection": "first", "transitions": 30, "checkpoints": [0], "partial": "drop", "padding": "drop"}
    assert {key: configuration[key] for key in expected} == expected
    assert store.actions_spec is not None and store.actions_spec.size == ACTIONS
    assert store.class_names["actions"] == ["NOOP", "FIRE", "RIGHT", "LEFT"]
    assert "Breakout/1/replay_logs" in str(store.attributes["source"])


def test_the_seed_decides_every_byte(logs: Path) -> None:
    log_as_dopamine(logs, play([15] * 60), capacity=300)
    chosen = {"transitions": 200, "per_visit": 1, "side": "top", "side_width": 3}
    prints = [load(logs, seed=seed, **chosen).fingerprint for seed in (1, 1, 2)]
    assert prints[0] == prints[1] != prints[2]
    clips = [load(logs, seed=seed, selection="all", side="top").array("factors/clip")[:].copy() for seed in (1, 2)]
    assert (clips[0] != clips[1]).any()


def test_checkpoint_50_is_not_drawn_from_by_itself(logs: Path) -> None:
    for number in (49, 50):
        write_checkpoint(logs, number, play([6] * 30, seed=number))
    assert json.loads(str(load(logs).attributes["configuration"]))["checkpoints"] == [49]
    chosen = load(logs, checkpoints=[50]).attributes["configuration"]
    assert json.loads(str(chosen))["checkpoints"] == [50]


def test_on_the_command_line(logs: Path, capsys: pytest.CaptureFixture) -> None:
    from repdib_lightning.__main__ import main

    for number in (0, 1, 2):
        write_checkpoint(logs, number, play([6] * 5, seed=number))
    output = logs.parents[2] / "store.h5"
    words = ["import", "dqn_replay", str(logs.parent), str(output), "--selection", "all", "--checkpoints", "[0,2]"]
    assert main([*words, "--game", "Pong"]) == 0
    assert len(EpisodeStore(output).starts) == 10
    told = capsys.readouterr()
    assert f"wrote {output}" in told.out and "60 transitions of pong in 10 episodes of checkpoints 0, 2" in told.err
