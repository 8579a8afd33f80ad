"""Episodes recorded with the action that LED TO each observation, and their shift into a store's rows.

Row t of such a recording holds (action, reward, observation) of one environment step, in the order in which they
happened; row 0 is the reset, with a placeholder action. A store holds the action taken AT an observation, so its row t
gets the recording's action and reward of row t + 1.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from tqdm import tqdm

from repdib_lightning.data.writer import EpisodeWriter
from repdib_lightning.errors import UserError
from repdib_lightning.records import ActionSpec, ArraySpec


@dataclass(frozen=True)
class RecordedShape:
    """What the first pass over the files learns: E, N, (C, H, W) and A."""

    episodes: int
    rows: int
    image: tuple[int, ...]
    action_size: int


@dataclass(frozen=True)
class RecordedEpisode:
    """T rows: images (T, C, H, W) uint8; actions (T, A); rewards, discounts (T,); row 0 of the last three is void."""

    images: np.ndarray
    actions: np.ndarray
    rewards: np.ndarray
    discounts: np.ndarray


class Recording(Protocol):
    """Files on disk whose size is known and whose episodes are read one at a time."""

    shape: RecordedShape

    def episodes(self) -> Iterator[RecordedEpisode]:
        """All episodes in order; only one is held in memory. Raises UserError naming file and key."""
        ...


def write_recording(
    recording: Recording, output: Path, *, attributes: dict[str, Any], overwrite: bool, progress: bool
) -> Path:
    """Write a recording as a store with the observation ``pixels`` and continuous actions.

    An episode ends in a termination where its last discount is 0, else in a truncation (a time limit).

    Raises:
        UserError: from reading (file and key) or writing (output exists, disk full); no output is left then.
    """
    shape = recording.shape
    writer = EpisodeWriter(
        output,
        rows=shape.rows,
        episodes=shape.episodes,
        observations={"pixels": ArraySpec(shape.image)},
        actions=ActionSpec("continuous", shape.action_size),
        rewards=True,
        attributes=attributes,
        overwrite=overwrite,
    )
    with writer, tqdm(total=shape.rows, desc="import", unit="row", disable=not progress) as bar:
        for episode in recording.episodes():
            last = np.zeros(len(episode.images) - 1, bool)
            last[-1] = True
            terminated = episode.discounts[-1] == 0
            writer.add_episode(
                observations={"pixels": episode.images},
                actions=episode.actions[1:],
                rewards=episode.rewards[1:],
                terminations=last & terminated,
                truncations=last & ~terminated,
            )
            bar.update(len(episode.images))
    return output


def check_image(path: Path, key: str, shape: tuple[int, ...], dtype: np.dtype[Any], *, channels_axis: int) -> None:
    """Refuse pictures that are not (T, ...) uint8 with 1 or 3 channels.

    Raises:
        UserError: naming file and key.
    """
    if dtype != np.uint8:
        raise UserError(f"{path}: '{key}' is {dtype}, must be uint8")
    layout = "(T, C, H, W)" if channels_axis == 1 else "(T, H, W, C)"
    if len(shape) != 4:
        raise UserError(f"{path}: '{key}' has shape {shape}, must be {layout}")
    if shape[channels_axis] not in (1, 3):
        raise UserError(f"{path}: '{key}' has shape {shape}, must be {layout} with 1 or 3 channels (un-stacked frames)")


def numbers(path: Path, key: str, array: np.ndarray, rows: int, *, width: bool = False) -> np.ndarray:
    """Return (rows,) float32, or (rows, A) with ``width``; (rows, 1) is accepted where one number a row is meant.

    Raises:
        UserError: naming file and key, where the type is not a number or the shape disagrees with the pictures.
    """
    if array.dtype.kind not in ("f" if width else "fiub"):
        raise UserError(f"{path}: '{key}' is {array.dtype}, must be {'floating point' if width else 'numbers'}")
    if not width and array.ndim == 2 and array.shape[1] == 1:
        array = array[:, 0]
    if array.ndim != (2 if width else 1):
        raise UserError(f"{path}: '{key}' has shape {array.shape}, must be {'(T, A)' if width else '(T,)'}")
    if len(array) != rows:
        raise UserError(f"{path}: '{key}' has {len(array)} rows, the pictures have {rows}")
    return array.astype(np.float32)


def check_finite(path: Path, first_row: int, values: dict[str, np.ndarray]) -> None:
    """Refuse NaN and infinity in the rows of one episode after its reset row: key -> (T,) or (T, A).

    Raises:
        UserError: naming file, key and the row in that file.
    """
    for key, array in values.items():
        bad = np.flatnonzero(~np.isfinite(array.reshape(len(array), -1)).all(axis=1))
        bad = bad[bad > 0]
        if len(bad):
            raise UserError(
                f"{path}: '{key}' is not finite (NaN or infinite) at row {first_row + int(bad[0])}; "
                f"{len(bad)} such rows in this episode"
            )


def check_early_end(path: Path, first_row: int, discounts: np.ndarray) -> None:
    """Refuse a discount of 0 (a termination) anywhere but in the last row of an episode: (T,).

    Raises:
        UserError: naming file and row.
    """
    early = np.flatnonzero(discounts[1:-1] == 0)
    if len(early):
        row = first_row + int(early[0]) + 1
        raise UserError(f"{path}: 'discount' is 0 at row {row}, before the end of its episode")
