"""A suite: a base run, grids of settings around it, and seeds."""

from __future__ import annotations

import itertools
import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

from repdib_lightning.errors import UserError
from repdib_lightning.rl import FRESH_OPTIONS, GIVEN_OPTIONS

FIRST_DEVELOPMENT_SEED = 100
"""Seeds below are for reporting only; what is tuned is tuned on this one and above."""

CONFIG = "config"
"""The axis whose values are configurations instead of values of a key."""

SET_BY_SUITE = ("seed_everything", "data.seed", "data.init_args.seed", "data.path", "data.init_args.path", "run")
"""Options of ``fit`` that follow from the suite's data and seeds, so that no setting may give them."""

EXPLORATION = "ExplorationDataModule"
"""The data class whose ``fit`` explores: it makes its data itself. Written out, since it imports torch."""

SNAPSHOT, SNAPSHOTS = "snapshot", "snapshots"
"""Option of ``finetune``; key of a suite's fine-tuning and of an exploration's data."""

PROBE_OPTIONS = ("probes", "groups", "clusters", "device", "seed")

PHASES = ("fit", "export", "probe", "finetune")
"""Verbs that points go through, in this order; a setting may have only some of them."""


@dataclass(frozen=True)
class Finetune:
    """Fine-tunings by reinforcement learning that every point of a setting goes through.

    Attributes:
        agent: as ``finetune AGENT`` takes it.
        runs: name -> options of ``finetune``, its environment or task among them; the name is a folder and part of the
            measures'.
        snapshots: name in the file -> frames of an exploration -> which of the runs begins there; empty without.
    """

    agent: str
    runs: Mapping[str, Mapping[str, Any]]
    snapshots: Mapping[str, Mapping[int, str]] = field(default_factory=dict)

    def arguments(self, name: str, seed: int) -> list[str]:
        """What ``finetune`` is given for one of the runs, but for the encoder and the run's folder."""
        options = [word for key, value in self.runs[name].items() for word in (f"--{key}", _as_word(value))]
        return [self.agent, *options, "--seed", str(seed)]

    def of_an_encoder(self) -> Finetune:
        """The same where an encoder is given: without the options of a fresh one."""
        return self._without(FRESH_OPTIONS)

    def from_scratch(self) -> Finetune:
        """The same where no encoder is given: without the options of one that is."""
        return self._without(GIVEN_OPTIONS)

    def _without(self, left_out: Sequence[str]) -> Finetune:
        runs = {
            name: {option: value for option, value in options.items() if option not in left_out}
            for name, options in self.runs.items()
        }
        return replace(self, runs=runs)

    def from_snapshots(self, frames: Sequence[int]) -> Finetune:
        """Every run from each snapshot of an exploration, as NAME_FRAMES; the same without any."""
        if not frames:
            return self
        snapshots = {name: {count: f"{name}_{count}" for count in sorted(frames)} for name in self.runs}
        runs = {
            run: {**self.runs[name], SNAPSHOT: count} for name, by in snapshots.items() for count, run in by.items()
        }
        return replace(self, runs=runs, snapshots=snapshots)


@dataclass(frozen=True)
class Setting:
    """One cell of a grid: everything of a run but its seed.

    Attributes:
        grid, name: where it stands; ``grid/name`` is its folder.
        configs: configurations as ``fit --config`` takes them, later ones over earlier ones.
        options: dotted key -> value, over all of them.
        merged: what these files and options say together.
        data: the store that it is trained and probed on, or only probed on if it explores; None without pre-training.
        probe_data: the store that it is probed on in place of ``data``; None for that one.
        pretrained: whether there is an encoder to train, export and probe; else fine-tuning begins from scratch.
        finetune: what follows; None for nothing.
    """

    grid: str
    name: str
    configs: tuple[str, ...]
    options: Mapping[str, Any]
    merged: Mapping[str, Any]
    data: Path | None = None
    probe_data: Path | None = None
    pretrained: bool = True
    finetune: Finetune | None = None

    @property
    def probed_on(self) -> Path | None:
        """The store that it is probed on; None without pre-training."""
        return self.probe_data or self.data

    @property
    def place(self) -> str:
        """``grid/name``."""
        return f"{self.grid}/{self.name}"

    @property
    def explores(self) -> bool:
        """Whether ``fit`` acts in an environment and records what it learns from, instead of reading a store."""
        return explores(self.merged)

    @property
    def phases(self) -> tuple[str, ...]:
        """Those of :data:`PHASES` that its points go through."""
        before = PHASES[:-1] if self.pretrained else ()
        return (*before, *PHASES[-1:]) if self.finetune is not None else before

    def arguments(self, seed: int) -> list[str]:
        """What ``fit`` is given, but for the run's folder; nothing where there is no fit."""
        if not self.pretrained:
            return []
        configs = [word for name in self.configs for word in ("--config", name)]
        options = [word for key, value in self.options.items() for word in (f"--{key}", _as_word(value))]
        return [*configs, *options, "--seed_everything", str(seed), "--data.seed", str(seed)]


@dataclass(frozen=True)
class Grid:
    """Settings that are compared with each other.

    Attributes:
        name: of the table that it becomes. about: a line above that table.
        settings: in the order of the file; ``baseline`` is the name of the one that the others are compared with.
        data: the store that its settings are trained and probed on, or only probed on if they explore.
        collect: words of a ``collect`` command that makes the store where it is absent; empty for none.
        seeds: of the suite's reported seeds, those that its settings are run with; empty for all.
        probe: options of ``probe`` in place of the suite's; None for those.
        probe_data, probe_collect: the store that its settings are probed on in place of ``data``, and what makes it.
    """

    name: str
    about: str
    baseline: str
    settings: tuple[Setting, ...]
    data: Path
    collect: tuple[str, ...]
    seeds: tuple[int, ...] = ()
    probe: Mapping[str, Any] | None = None
    probe_data: Path | None = None
    probe_collect: tuple[str, ...] = ()

    @property
    def stores(self) -> dict[Path, tuple[str, ...]]:
        """Store -> words of the command that makes it."""
        own = {self.data: self.collect}
        return own if self.probe_data is None else {**own, self.probe_data: self.probe_collect}

    def numbers(self, option: str) -> dict[str, float]:
        """Name of a setting -> value of a dotted option of ``fit``, of those whose value is a number."""
        found = {setting.name: _at(setting.merged, option) for setting in self.settings}
        return {name: float(v) for name, v in found.items() if isinstance(v, int | float) and not isinstance(v, bool)}

    def has_seed(self, seed: int, reported: Sequence[int]) -> bool:
        """Whether its settings are run with a seed: one of its own, or one that the suite does not report."""
        return not self.seeds or seed in self.seeds or seed not in reported


@dataclass(frozen=True)
class HeadlineRow:
    """A row of a paper's table, and what is measured for it here.

    Attributes:
        label: as the report prints it.
        measure: of a probe of factors or of the pictures without its last part (``linear/time_step``), then error and
            kept are shown, relative to the baseline; or a whole one (``recognition/f1_macro``), then shown as it is.
        paper: setting -> printed value; relative to the baseline, or in the unit of a whole measure.
        grid: of a whole measure; empty for the first one.
    """

    label: str
    measure: str
    paper: Mapping[str, float]
    grid: str = ""


@dataclass(frozen=True)
class Claim:
    """A sentence that the report holds against the numbers of a grid.

    Attributes:
        text: the sentence. grid: empty for the first one. setting, measure: what it speaks of.
        of: ``value`` of the setting, or its ``difference`` from or ``ratio`` to another one (means, seeds in pairs).
        than: that other setting; the baseline by default.
        at_most, at_least: bounds; None for none.
        judge: whether the ``mean`` must keep the bound, the ``whole`` 95 % interval, or ``any`` of that interval; by
            ``interval`` a claim holds if all of it does, fails if none of it does, and else cannot be told.
    """

    text: str
    setting: str
    measure: str
    of: str = "value"
    than: str = ""
    at_most: float | None = None
    at_least: float | None = None
    judge: str = "mean"
    grid: str = ""


@dataclass(frozen=True)
class Against:
    """A figure of measures against a number that a grid's settings vary.

    Attributes:
        name: of the figure. grid: whose settings. option: dotted, as ``fit`` takes it; a setting where it is no number
            is drawn as a horizontal line. measures: a panel each.
    """

    name: str
    grid: str
    option: str
    measures: tuple[str, ...]


@dataclass(frozen=True)
class Suite:
    """Everything that a suite's file says.

    Attributes:
        name: the file's name without its ending. title: of the report.
        file: where it was read.
        data, collect: of the grids that have none of their own.
        seeds: reported. tune_seeds: used with ``--tune``.
        threads: of each point's processes; part of the result, since the order of sums depends on it.
        probe: further options of ``probe``.
        slurm: parameters of a SLURM job, by submitit's names.
        grids: by name, in the order of the file.
        headline: rows of the first grid's table beside the paper's. claims: held against the numbers.
        measures: shown in the tables beside what the probes read (:mod:`repdib_lightning.experiments.measures`).
        curves: columns of metrics.csv to draw. finetune_curves: columns of the fine-tunings' progress.csv to draw.
        show: settings of the first grid whose latents and drawn pictures are shown. colours: factors that colour them.
        maps: settings whose maps of mazes are shown; empty for all.
        overview: measures that the report draws over all grids, first of all.
        against: figures of measures against a number that a grid's settings vary.
        films: places (``grid/setting``) of the settings whose policies are shown in films.
        drawn_groups: places of the settings of which the report shows what each group draws.
        recognised: places of the settings of which the report shows what is recognised, and by which modality.
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
    finetune_curves: tuple[str, ...] = ("eval/success",)
    maps: tuple[str, ...] = ()
    films: tuple[str, ...] = ()
    overview: tuple[str, ...] = ()
    against: tuple[Against, ...] = ()
    drawn_groups: tuple[str, ...] = ()
    recognised: tuple[str, ...] = ()

    def grid(self, name: str) -> Grid:
        """The grid of this name; the first one for an empty name."""
        return next((grid for grid in self.grids if grid.name == name), self.grids[0])

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

    def probe_of(self, setting: Setting) -> Mapping[str, Any]:
        """Further options of ``probe`` for a setting."""
        own = self.grid(setting.grid).probe
        return self.probe if own is None else own

    def has(self, setting: Setting, seed: int) -> bool:
        """Whether a setting is run with a seed: whether one of the grids that it is in has it."""
        same = identity(setting)
        grids = [grid for grid in self.grids if any(identity(other) == same for other in grid.settings)]
        return any(grid.has_seed(seed, self.seeds) for grid in grids)

    def run_by(self, setting: Setting) -> Setting:
        """The setting whose runs this one shares (mostly itself)."""
        return self._first[identity(setting)]


def explores(merged: Mapping[str, Any]) -> bool:
    """Whether a configuration's data are made by exploring."""
    data = merged.get("data")
    named = data.get("class_path") if isinstance(data, Mapping) else data
    return str(named).rpartition(".")[2] == EXPLORATION


def identity(setting: Setting) -> str:
    """A text that is equal for two settings that are the same run."""
    finetune = None if setting.finetune is None else asdict(setting.finetune)
    parts = [setting.merged, setting.data, setting.probe_data, setting.pretrained, finetune]
    return json.dumps(parts, sort_keys=True, default=str)


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


def _at(tree: Mapping[str, Any], option: str) -> Any:
    value: Any = tree
    for word in option.split("."):
        value = value.get(word) if isinstance(value, Mapping) else None
    return value


def _as_word(value: Any) -> str:
    return value if isinstance(value, str) else json.dumps(value)
