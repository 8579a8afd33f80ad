"""Explorations of seconds, and what they leave."""

from __future__ import annotations

import csv
from pathlib import Path
from typing import Any

from repdib_lightning.__main__ import main

SIDE, REPEAT = 32, 50
TINY = [
    *("--config", "urlb/walker_repdib", "--trainer.enable_progress_bar", "false", "--model.hidden", "16"),
    *("--model.encoder.init_args.features", "16", "--model.bottleneck.init_args.start_step", "3"),
    *("--model.bottleneck.init_args.groups", "4", "--model.bottleneck.init_args.codes", "6"),
    *("--model.encoder.init_args.channels", "4", "--model.queue", "64"),
    *("--model.objective.init_args.prototypes", "16", "--model.objective.init_args.hidden", "16"),
    *("--data.processes", "false", "--data.batch_size", "8", "--data.image_size", str(SIDE)),
    *("--data.seed_frames", "0", "--data.action_repeat", str(REPEAT)),
]


def fit(run: str, frames: int, snapshots: str, *more: str) -> list[str]:
    """Arguments of a run."""
    return ["fit", *TINY, "--run", str(run), "--data.frames", str(frames), "--data.snapshots", str(snapshots), *more]


def rows(run: str) -> list[dict[str, str]]:
    """Of metrics.csv, as text."""
    with open(Path(run) / "metrics.csv", newline="") as file:
        return list(csv.DictReader(file))


def tree(folder: str) -> dict[str, int]:
    return {str(path): path.stat().st_size for path in Path(folder).rglob("*")}


def complaint(capsys: Any, *arguments: str) -> str:
    """The one line of a command that must fail and leave nothing."""
    capsys.readouterr()
    before = tree(".")
    assert main(list(arguments)) == 2
    lines = [line for line in capsys.readouterr().err.strip().splitlines() if not line.startswith("Seed set")]
    assert len(lines) == 1 and tree(".") == before, lines
    return lines[0]
