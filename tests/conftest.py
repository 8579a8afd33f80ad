"""Small stores that every test may use."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from repdib_lightning.data.schema import FactorSpec
from repdib_lightning.data.writer import EpisodeWriter
from repdib_lightning.records import ActionSpec, ArraySpec

torch.set_num_threads(1)  # tests are small; threads that wait for each other on a busy machine are not


def write_store(
    path: Path,
    *,
    lengths: tuple[int, ...] = (13, 9, 11, 12),
    evaluation: tuple[int, ...] = (2, 3),
    size: int = 24,
    kind: str | None = "discrete",
    seed: int = 0,
    **options: Any,
) -> Path:
    """A store whose pictures show the cell as a bright square, whose noise fills the rest.

    Pixel (0, 0) of channel 0 holds the row number modulo 251, so that a picture tells where it came from.
    """
    generator = np.random.default_rng(seed)
    rows = sum(lengths)
    actions = None if kind is None else ActionSpec(kind, 4 if kind == "discrete" else 2)  # type: ignore[arg-type]
    views = {name: ArraySpec((3, size, size)) for name in ("front", "top")}
    factors = {
        "cell": FactorSpec("endogenous", "categorical", classes=4),
        "light": FactorSpec("exogenous", "continuous"),
    }
    with EpisodeWriter(
        path, rows=rows, episodes=len(lengths), observations=views, actions=actions, factors=factors, **options
    ) as writer:
        first = 0
        for episode, length in enumerate(lengths):
            light = generator.random(length).astype(np.float32)
            moves = generator.integers(0, 4, length - 1)
            cells = np.concatenate([[0], np.cumsum(moves)]) % 4
            pictures = {}
            for name in views:
                picture = (generator.random((length, 3, size, size)) * 80 * light[:, None, None, None]).astype(np.uint8)
                for t, cell in enumerate(cells):
                    y, x = divmod(int(cell), 2)
                    picture[t, :, 2 + y * 9 : 9 + y * 9, 2 + x * 9 : 9 + x * 9] = 255
                picture[:, 0, 0, 0] = np.arange(first, first + length) % 251
                pictures[name] = picture
            taken = moves if kind == "discrete" else generator.normal(size=(length - 1, 2)).astype(np.float32)
            writer.add_episode(
                observations=pictures,
                actions=None if kind is None else taken,
                factors={"cell": cells, "light": light},
                evaluation=episode in evaluation,
            )
            first += length
    return path


@pytest.fixture(scope="session")
def make_store() -> Callable[..., Path]:
    return write_store


@pytest.fixture
def store_file(tmp_path: Path) -> Path:
    return write_store(tmp_path / "small.h5")
