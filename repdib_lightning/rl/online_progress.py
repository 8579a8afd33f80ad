"""The record of an agent that learns while it plays: one row of progress.csv for each evaluation."""

from __future__ import annotations

import csv
import sys
import time
from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np
from torch.utils.tensorboard import SummaryWriter
from tqdm import tqdm

from repdib_lightning.rl.options import PROGRESS

Evaluate = Callable[[bool], np.ndarray]
"""Returns (n,) of an evaluation, when told whether it is the last one."""


class OnlineProgress:
    """Writes ``progress.csv``, logs the same to TensorBoard, and moves a bar where there is a terminal.

    Columns: ``step``, in frames; ``eval/return`` (mean); ``train/return``, mean over the episodes that have ended since
    the last row; ``train/...`` of the last update. TensorBoard alone is told ``train/rate``, frames a second without
    the evaluations: a table that tells it would differ from run to run.

    Args:
        folder: of the run. every: frames between evaluations. total: frames in all. evaluate: plays the episodes.

    Attributes:
        returns: (n,) of the last evaluation. rows: of the table.
    """

    def __init__(self, folder: Path, every: int, total: int, evaluate: Evaluate) -> None:
        self.folder, self.every, self.total, self.evaluate = folder, every, total, evaluate
        self.rows: list[dict[str, float]] = []
        self.returns = np.empty(0)
        self._columns: list[str] = []
        self._log = SummaryWriter(str(folder))
        self._bar = tqdm(total=total, unit=" frames", disable=not sys.stderr.isatty())
        self._since = time.monotonic()

    def is_due(self, frames: int) -> bool:
        """Whether the next evaluation has come; the one after all frames is asked for by itself. Moves the bar."""
        self._bar.update(frames - self._bar.n)
        evaluated = self.rows[-1]["step"] if self.rows else -1
        return frames < self.total and frames // self.every > evaluated // self.every

    def add(self, frames: int, trained: Mapping[str, float] | None = None) -> None:
        """Evaluate, and write a row.

        Args:
            frames: so far. trained: name -> value of the last update.
        """
        seconds, played = time.monotonic() - self._since, frames - (self.rows[-1]["step"] if self.rows else 0)
        self.returns = self.evaluate(frames >= self.total)
        reached = float(self.returns.mean())
        row = {"step": frames, "eval/return": reached}
        row |= {f"train/{name}": value for name, value in (trained or {}).items()}
        self._bar.set_postfix_str(f"return {reached:.0f}")
        self.rows.append(row)
        self._write()
        rate = {"train/rate": played / max(seconds, 1e-9)} if played else {}
        for name, value in (row | rate).items():
            if name != "step":
                self._log.add_scalar(name, value, frames)
        self._since = time.monotonic()

    def _write(self) -> None:
        new = [name for name in self.rows[-1] if name not in self._columns]
        self._columns += new
        with open(self.folder / PROGRESS, "w" if new else "a", newline="") as file:
            table = csv.DictWriter(file, self._columns, restval="")
            if new:
                table.writeheader()
            rows = self.rows if new else self.rows[-1:]
            table.writerows({n: v if n == "step" else f"{v:.6g}" for n, v in row.items()} for row in rows)

    def curve(self, name: str) -> np.ndarray:
        """(n,) values of a column, in order."""
        return np.array([row[name] for row in self.rows if name in row])

    def close(self) -> None:
        """Close the bar and the log."""
        self._bar.close()
        self._log.close()
