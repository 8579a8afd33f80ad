"""The finished points of a suite, and their numbers by setting and seed."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from repdib_lightning.errors import UserError
from repdib_lightning.experiments.points import Point, Record, points_of
from repdib_lightning.experiments.snapshot_measures import snapshot_measures
from repdib_lightning.experiments.suite import Grid, Setting, Suite


@dataclass(frozen=True)
class Results:
    """Finished points.

    Attributes:
        suite: whose they are. seeds: asked for.
        points: (place of a setting, seed) -> point. records: the same -> record.
        missing: names of points that are not finished.
    """

    suite: Suite
    seeds: tuple[int, ...]
    points: dict[tuple[str, int], Point]
    records: dict[tuple[str, int], Record]
    missing: list[str]

    def point(self, setting: Setting, seed: int) -> Point | None:
        """The point whose run a setting has for a seed; None if it is not finished."""
        return self.points.get((self.suite.run_by(setting).place, seed))

    def values(self, setting: Setting, measure: str) -> dict[int, float]:
        """Seed -> number, for the finished points that have this measure; of the seeds of the setting's grid."""
        place = self.suite.run_by(setting).place
        wanted = [seed for seed in self.seeds if self.suite.grid(setting.grid).has_seed(seed, self.suite.seeds)]
        found = {seed: self.records[place, seed] for seed in wanted if (place, seed) in self.records}
        return {seed: record.metrics[measure] for seed, record in found.items() if measure in record.metrics}

    def paired(self, ours: Setting, baseline: Setting, measure: str) -> tuple[np.ndarray, np.ndarray]:
        """Two (n,) arrays over the seeds that both have, in the same order."""
        first, second = self.values(ours, measure), self.values(baseline, measure)
        common = [seed for seed in first if seed in second]
        return np.array([first[seed] for seed in common]), np.array([second[seed] for seed in common])

    @property
    def factors(self) -> dict[str, str]:
        """Name -> ``state`` or ``noise``, of all data."""
        return {name: kind for record in self.records.values() for name, kind in record.factors.items()}

    def measures(self, grid: Grid) -> list[str]:
        """Names of all measures that a setting of the grid has, in order of first appearance."""
        names: dict[str, None] = {}
        for setting in grid.settings:
            for seed in self.seeds:
                record = self.records.get((self.suite.run_by(setting).place, seed))
                names |= dict.fromkeys(record.metrics if record else ())
        return list(names)


def load_results(suite: Suite, seeds: Iterable[int], runs: Path) -> Results:
    """Read every finished point of a suite; what its snapshots show is added to the measures of its record.

    Raises:
        UserError: none is finished, a record is damaged, or two runs are of different data.
    """
    wanted = tuple(seeds)
    points, records, missing = {}, {}, []
    for point in points_of(suite, wanted, runs):
        record = point.record()
        if record.finished:
            record.metrics |= snapshot_measures(record.metrics, point.setting.finetune)
            points[point.setting.place, point.seed] = point
            records[point.setting.place, point.seed] = record
        else:
            missing.append(point.name)
    if not records:
        raise UserError(
            f"{runs / suite.name}: no point is finished; first: python -m repdib_lightning suite run {suite.name}"
        )
    _check_same_data(points, records)
    return Results(suite, wanted, points, records, missing)


def _check_same_data(points: dict[tuple[str, int], Point], records: dict[tuple[str, int], Record]) -> None:
    """A store is the same for all that were trained or probed on it."""
    firsts: dict[Path, tuple[Point, str | None]] = {}
    for other, record in records.items():
        for store, done, used in _stores_of(points[other], record):
            first, expected = firsts.setdefault(store, (points[other], used.get("fingerprint")))
            if used.get("fingerprint") != expected:
                raise UserError(
                    f"{points[other].folder}: was {done} on other data than {first.folder} (fingerprints differ); "
                    "remove one of them and run the suite again"
                )


def _stores_of(point: Point, record: Record) -> list[tuple[Path, str, dict[str, str]]]:
    """The stores that the suite names, what was done on each, and what it was then; from scratch there may be none."""
    setting = point.setting
    found = [(setting.data, "trained", record.data), (setting.probe_data, "probed", record.probed)]
    if setting.explores:  # on a replay of its own
        found = [(setting.probed_on, "probed", record.probed)]
    return [(store, done, used) for store, done, used in found if store is not None]
