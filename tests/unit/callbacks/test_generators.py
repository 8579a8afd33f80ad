"""States of the generators survive a checkpoint."""

from __future__ import annotations

import random
from pathlib import Path

import numpy as np
import torch

from repdib_lightning.callbacks import generators
from repdib_lightning.callbacks.checkpoint_io import AtomicCheckpointIO

CPU = torch.device("cpu")


def draws() -> list[float]:
    """Draws of every kind; Gaussian ones leave half a pair behind in Python's and numpy's generators."""
    numbers = [random.random(), random.gauss(0, 1), np.random.rand(), np.random.normal()]  # noqa: NPY002
    return [*numbers, *torch.rand(3).tolist(), *torch.randn(17).tolist()]


def test_draws_repeat_after_a_round_trip_through_a_file(tmp_path: Path) -> None:
    for warm_up in range(3):
        for _ in range(warm_up):
            draws()
        AtomicCheckpointIO().save_checkpoint({"states": generators.capture(CPU)}, tmp_path / "a.ckpt")
        expected = draws() + draws()
        random.seed(99), np.random.seed(99), torch.manual_seed(99)  # noqa: NPY002
        assert draws() != expected[: len(expected) // 2]
        generators.restore(AtomicCheckpointIO().load_checkpoint(tmp_path / "a.ckpt")["states"], CPU)
        assert draws() + draws() == expected


def test_capturing_draws_nothing() -> None:
    states = generators.capture(CPU)
    generators.restore(states, CPU)
    expected = draws()
    generators.restore(states, CPU)
    generators.capture(CPU)
    assert draws() == expected
