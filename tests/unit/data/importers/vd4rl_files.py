"""Small files in exactly the published V-D4RL formats, with values that tell every row apart."""

from __future__ import annotations

from pathlib import Path

import h5py
import numpy as np

Episode = dict[str, np.ndarray]


def record(index: int, rows: int = 11, size: int = 84, actions: int = 6) -> Episode:
    """One episode in time order; row 0 is the reset with a zero action and reward."""
    generator = np.random.default_rng(index)
    action = generator.uniform(-1, 1, (rows, actions)).astype(np.float32)
    reward = generator.uniform(0, 1, rows).astype(np.float32)
    action[0], reward[0] = 0, 0
    step_type = np.ones(rows)
    step_type[0], step_type[-1] = 0, 2
    return {
        "observation": generator.integers(0, 256, (rows, 3, size, size), dtype=np.uint8),
        "action": action,
        "reward": reward,
        "discount": np.ones(rows, np.float32),
        "step_type": step_type,
    }


def as_npz(episode: Episode) -> Episode:
    """The keys of the 64 px form."""
    rows = len(episode["action"])
    return {
        "image": episode["observation"].transpose(0, 2, 3, 1),
        "action": episode["action"],
        "reward": episode["reward"],
        "discount": episode["discount"],
        "is_first": np.arange(rows) == 0,
        "is_last": np.arange(rows) == rows - 1,
        "is_terminal": np.zeros(rows, bool),
    }


def write_npz(folder: Path, index: int, keys: Episode, *, length: int | None = None) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    rows = len(keys["action"]) if length is None else length
    path = folder / f"20220601T1200{index:02d}-{index:032x}-{rows}.npz"
    np.savez_compressed(path, **keys)
    return path


def write_shard(path: Path, keys: Episode) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    with h5py.File(path, "w") as file:
        for name, values in keys.items():
            file.create_dataset(name, data=values, compression="gzip")
    return path


def concatenate(episodes: list[Episode]) -> Episode:
    return {key: np.concatenate([episode[key] for episode in episodes]) for key in episodes[0]}


def split(keys: Episode, cuts: list[int]) -> list[Episode]:
    pieces = {key: np.split(values, cuts) for key, values in keys.items()}
    return [{key: pieces[key][index] for key in keys} for index in range(len(cuts) + 1)]
