"""Finished points of a suite, made up: what a report reads, without training anything."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np

from repdib_lightning.evaluation.decoder import Drawings
from repdib_lightning.evaluation.samples import ProbeSamples
from repdib_lightning.experiments.points import Point, points_of
from repdib_lightning.experiments.suite import Suite
from repdib_lightning.experiments.suite_file import read_suite

SUITE = """
title: A made-up suite
base: [robot_arm]
data: data/x.h5
seeds: [0, 1, 2, 3, 4]
grids:
  bottleneck:
    about: Only the bottleneck differs.
    baseline: none
    vary:
      config: [bottleneck/none, bottleneck/vq, bottleneck/repdib]
  groups:
    baseline: groups_8
    with: {config: bottleneck/repdib}
    vary:
      model.bottleneck.init_args.groups: [4, 8]
headline:
  time:
    measure: linear/time/error_or_kept
    paper: {none: 1.0, vq: 0.70, repdib: 0.66}
claims: {}
measures: [val/raw/inverse]
curves: [train/raw/inverse, train/used_codes]
show: [none, repdib]
colours: [cell, time]
"""

Numbers = Callable[[str, int], dict[str, float]]
"""Setting and seed -> metrics."""


def write_suite(folder: Path, **replaced: str) -> Path:
    """The suite above as a file; each replacement is old text -> new text."""
    text = SUITE.replace("linear/time/error_or_kept", "linear/time")
    for old, new in replaced.items():
        assert old in text
        text = text.replace(old, new)
    path = folder / "made_up.yaml"
    path.write_text(text)
    return path


def finish(suite: Suite, runs: Path, numbers: Numbers, seeds: tuple[int, ...] | None = None) -> list[Point]:
    """Write records and run folders of every point."""
    points = points_of(suite, suite.seeds if seeds is None else seeds, runs)
    for point in points:
        _write_run(point)
        record = point.record()
        record.finished, record.threads, record.seconds = True, 1, {"fit": 10.0}
        record.factors = {"cell": "state", "time": "noise"}
        record.versions = {"torch": "2.10"}
        record.data = {"file": "x.h5", "fingerprint": "abc"}
        record.configuration = {"seed_everything": point.seed}
        record.metrics = numbers(point.setting.name, point.seed)
        point.write(record)
    return points


def made_up(folder: Path, numbers: Numbers) -> tuple[Path, Suite, Path]:
    """A suite's file, the suite, and the folder of runs with all points finished."""
    path = write_suite(folder)
    suite = read_suite(path)
    finish(suite, folder / "runs", numbers)
    return path, suite, folder / "runs"


def typical(setting: str, seed: int) -> dict[str, float]:
    """State kept by all; noise dropped by vq, more so by repdib and its groups."""
    kept = {"none": 0.8, "vq": 0.2}.get(setting, 0.1) + 0.01 * seed
    found = {
        "val/raw/inverse": 1.2 + 0.001 * seed,
        "linear/cell/kept": 1.0,
        "linear/cell/error": 0.0,
        "linear/time/kept": kept,
        "linear/time/error": 1.0 - kept,
        "linear/state/kept": 1.0,
        "linear/noise/kept": kept,
        "mlp/time/kept": kept,
    }
    return found if setting == "none" else {**found, "codes/used": 30.0 + seed}


def _write_run(point: Point) -> None:
    point.folder.mkdir(parents=True)
    quantised = point.setting.name != "none"
    generator = np.random.default_rng(point.seed)
    header = "epoch,step,train/raw/inverse" + ",train/used_codes" * quantised
    rows = [f"0,{step},{1.6 - 0.01 * step + 0.01 * point.seed}" + ",30" * quantised for step in (9, 19, 29)]
    (point.folder / "metrics.csv").write_text("\n".join([header, *rows]) + "\n")
    use = {"codes_per_group": 50, "used": [30, 31], "perplexity": [20.5, 21.0]} if quantised else None
    (point.folder / "probe.json").write_text(json.dumps({"codebook": use}))
    pictures = {"front": generator.integers(0, 255, (2, 3, 8, 8)).astype(np.uint8)}
    factors = {"cell": np.arange(30) % 3, "time": np.linspace(0, 1, 30, dtype=np.float32)}
    latents = generator.normal(size=(30, 4)).astype(np.float32)
    drawings = Drawings(np.array([1, 2]), pictures, pictures)
    ProbeSamples(np.arange(30), latents, factors, drawings).write(point.folder / "probe.npz")
