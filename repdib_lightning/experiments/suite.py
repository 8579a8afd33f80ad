"""A suite: a base run, grids of settings around it, and seeds."""

from __future__ import annotations

import itertools
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from repdib_lightning.errors import UserError

FIRST_DEVELOPMENT_SEED = 100
"""Seeds below are for reporting only; what is tuned is tuned on this one and above."""

CONFIG = "config"
"""The axis whose values are configurations instead of values of a key."""

SET_BY_SUITE = ("seed_everything", "data.seed", "data.init_args.seed", "data.path", "data.init_args.path", "run")
"""Options of ``fit`` that follow from the suite's data and seeds, so that no setting may give them."""

PROBE_OPTIONS = ("probes", "device", "seed")


@dataclass(frozen=True)
class Setting:
    """One cell of a grid: everything of a run but its seed.

    Attributes:
        grid, name: where it stands; ``grid/name`` is its folder.
        configs: configurations as ``fit --config`` takes them, later ones over earlier ones.
        options: dotted key -> value, over all of them.
        merged: what these files and options say together; two settings that agree in it are the same run.
    """

    grid: str
    name: str
    configs: tuple[str, ...]
    options: Mapping[str, Any]
    merged: Mapping[str, Any]

    @property
    def place(self) -> str:
        """``grid/name``."""
        return f"{self.grid}/{self.name}"

    def arguments(self, seed: int) -> list[str]:
        """What ``fit`` is given, but for the run's folder."""
        configs = [word for name in self.configs for word in ("--config", name)]
        options = [word for key, value in self.options.items() for word in (f"--{key}", _as_word(value))]
        return [*configs, *options, "--seed_everything", str(seed), "--data.seed", str(seed)]


@dataclass(frozen=True)
class Grid:
    """Settings that are compared with each other.

    Attributes:
        name: of the table that it becomes. about: a line above that table.
        settings: in the order of the file; ``baseline`` is the name of the one that the others are compared with.
    """

    name: str
    about: str
    baseline: str
    settings: tuple[Setting, ...]


@dataclass(frozen=True)
class HeadlineRow:
    """A row of a paper's table, and what is measured for it here.

    Attributes:
        label: as the report prints it. measure: without its last part (``linear/time_step``): error and kept are shown.
        paper: setting -> printed value, relative to the baseline.
    """

    label: str
    measure: str
    paper: Mapping[str, float]


@dataclass(frozen=True)
class Claim:
    """A sentence that the report holds against the numbers of the first grid.

    Attributes:
        text: the sentence. setting, measure: what it speaks of.
        of: ``value`` of the setting, or its ``difference`` from or ``ratio`` to another one (means, seeds in pairs).
        than: that other setting; the baseline by default.
        at_most, at_least: bounds; None for none.
        judge: whether the ``mean`` must keep the bound, the ``whole`` 95 % interval, or ``any`` of that interval.
    """

    text: str
    setting: str
    measure: str
    of: str = "value"
    than: str = ""
    at_most: float | None = None
    at_least: float | None = None
    judge: str = "mean"


@dataclass(frozen=True)
class Suite:
    """Everything that a suite's file says.

    Attributes:
        name: the file's name without its ending. title: of the report.
        file: where it was read.
        data: the store that every point is trained and probed on.
        collect: words of a ``collect`` command that makes the store where it is absent; empty for none.
        seeds: reported. tune_seeds: used with ``--tune``.
        threads: of each point's processes; part of the result, since the order of sums depends on it.
        probe: further options of ``probe``.
        slurm: parameters of a SLURM job, by submitit's names.
        grids: by name, in the order of the file.
        headline: rows of the first grid's table beside the paper's. claims: about the first grid.
        measures: shown in the tables beside what the probes read (:mod:`repdib_lightning.experiments.measures`).
        curves: columns of metrics.csv to draw.
        show: settings of the first grid whose latents and drawn pictures are shown. colours: factors that colour them.
    """

    name: str
    title: str
    file: Path
    data: Path
    collect: tuple[str, ...]
    seeds: tuple[int, ...]
    tune_seeds: tuple[int, ...]
    threads: int
    probe: Mapping[str, Any]
    slurm: Mapping[str, Any]
    grids: tuple[Grid, ...]
    headline: tuple[HeadlineRow, ...] = ()
    claims: tuple[Claim, ...] = ()
    measures: tuple[str, ...] = ()
    curves: tuple[str, ...] = ("train/loss",)
    show: tuple[str, ...] = ()
    colours: tuple[str, ...] = ()

    @cached_property
    def settings(self) -> list[Setting]:
        """Every setting once: where two grids share a run, the first one's."""
        return list(self._first.values())

    @cached_property
    def _first(self) -> dict[str, Setting]:
        kept: dict[str, Setting] = {}
        for setting in itertools.chain.from_iterable(grid.settings for grid in self.grids):
            kept.setdefault(identity(setting), setting)
        return kept

    def run_by(self, setting: Setting) -> Setting:
        """The setting whose runs this one shares (mostly itself)."""
        return self._first[identity(setting)]


def identity(setting: Setting) -> str:
    """A text that is equal for two settings that are the same run."""
    return json.dumps(setting.merged, sort_keys=True, default=str)


def check_seeds(seeds: Sequence[int], *, tune: bool, where: str) -> None:
    """Raise UserError where a reported seed would be tuned on, or a development seed reported."""
    for seed in seeds:
        if tune and seed < FIRST_DEVELOPMENT_SEED:
            raise UserError(
                f"{where}: seed {seed} is for reporting only, nothing may be tuned on it; --tune takes seeds from "
                f"{FIRST_DEVELOPMENT_SEED} on"
            )
        if not tune and seed >= FIRST_DEVELOPMENT_SEED:
            raise UserError(
                f"{where}: seed {seed} is for development, what it shows is not reported; add --tune, or take seeds "
                f"below {FIRST_DEVELOPMENT_SEED}"
            )


def _as_word(value: Any) -> str:
    return value if isinstance(value, str) else json.dumps(value)
