"""Small DQN-replay logs in exactly the published form, with values that tell every row apart."""

from __future__ import annotations

import gzip
from pathlib import Path

import numpy as np

Rows = dict[str, np.ndarray]

SIZE = 10
ACTIONS = 4  # of Breakout


def play(lengths: list[int], *, padded: bool = True, seed: int = 0, size: int = SIZE) -> Rows:
    """Episodes of so many actions, one after the other, as the replay memory stores them."""
    random = np.random.default_rng(seed)
    parts: list[Rows] = []
    for length in lengths:
        rows = length + (3 if padded else 0)
        part = {
            "observation": random.integers(1, 256, (rows, size, size), dtype=np.uint8),
            "action": random.integers(0, ACTIONS, rows).astype(np.int32),
            "reward": random.choice([0, 0, 0, 1, 4.5], rows).astype(np.float32),
            "terminal": np.zeros(rows, np.uint8),
        }
        part["terminal"][-1] = 1
        for array in part.values():
            array[: rows - length] = 0
        parts.append(part)
    return {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}


def write_array(path: Path, array: np.ndarray) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    with gzip.open(path, "wb", compresslevel=1) as file:
        np.save(file, array, allow_pickle=False)
    return path


def array_file(folder: Path, name: str, number: int) -> Path:
    return folder / f"$store$_{name}_ckpt.{number}.gz"


def write_checkpoint(folder: Path, number: int, rows: Rows, *, add_count: int | None = None) -> None:
    for name, array in rows.items():
        write_array(array_file(folder, name, number), array)
    if add_count is not None:
        write_array(folder / f"add_count_ckpt.{number}.gz", np.array(add_count))
    write_array(folder / f"invalid_range_ckpt.{number}.gz", np.arange(5))


def log_as_dopamine(folder: Path, rows: Rows, capacity: int) -> int:
    """Go through the ring of a replay memory, which is logged when one row is missing to its next round.

    Returns:
        How many checkpoints there are.
    """
    memory = {name: np.full((capacity, *array.shape[1:]), 77, array.dtype) for name, array in rows.items()}
    number = 0
    for row in range(len(rows["action"])):
        for name, array in rows.items():
            memory[name][row % capacity] = array[row]
        if (row + 1) % capacity == capacity - 1:
            write_checkpoint(folder, number, memory, add_count=row + 1)
            number += 1
    return number


def read_all(folder: Path, number: int) -> Rows:
    """A checkpoint, unzipped into memory."""
    arrays = {}
    for name in ("observation", "action", "reward", "terminal"):
        with gzip.open(array_file(folder, name, number)) as file:
            arrays[name] = np.load(file)
    return arrays
