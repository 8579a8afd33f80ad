"""A suite: a base run, grids of settings around it, and seeds, read from one YAML file."""

from __future__ import annotations

import itertools
import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

from repdib_lightning import configurations
from repdib_lightning.errors import UserError, nearest
from repdib_lightning.experiments.merging import merged, with_option

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

    @property
    def settings(self) -> list[Setting]:
        """Every setting once: where two grids share a run, the first one's."""
        kept: dict[str, Setting] = {}
        for setting in itertools.chain.from_iterable(grid.settings for grid in self.grids):
            kept.setdefault(identity(setting), setting)
        return list(kept.values())

    def run_by(self, setting: Setting) -> Setting:
        """The setting whose runs this one shares (mostly itself)."""
        return next(other for other in self.settings if identity(other) == identity(setting))


def identity(setting: Setting) -> str:
    """A text that is equal for two settings that are the same run."""
    return json.dumps(setting.merged, sort_keys=True, default=str)


def find_suite(name: str | Path) -> Path:
    """The file that is meant: an existing path, else the name of a packaged suite.

    Raises:
        UserError: neither, with the nearest packaged name.
    """
    if Path(name).is_file():
        return Path(name)
    known = configurations.packaged_suites()
    short = str(name).removesuffix(".yaml").removeprefix("conf/suites/")
    if short not in known:
        raise UserError(f"suite {name}: no such file or packaged suite; {nearest(short, known)}")
    return known[short]


def read_suite(name: str | Path) -> Suite:
    """Read and check a suite.

    Raises:
        UserError: naming the file and the key: not YAML, an unknown key, a missing one, or a value that cannot be.
    """
    file = find_suite(name)
    try:
        tree = yaml.safe_load(file.read_text())
    except (yaml.YAMLError, ValueError, OSError) as error:
        raise UserError(f"{file}: not valid YAML ({str(error).splitlines()[-1].strip()})") from error
    _check_keys(file, "", tree, {"base", *Suite.__dataclass_fields__} - {"name", "file"})
    for key in ("base", "data", "grids"):
        if key not in tree:
            raise UserError(f"{file}: '{key}' is missing (needed: base, data, grids)")
    if not isinstance(tree["data"], str) or not tree["data"]:
        raise UserError(f"{file}: data must name a store, such as data/robot_arm.h5, is {tree['data']!r:.60}")
    base = [_config(file, "base", item) for item in _listed(tree["base"])]
    grids = tree["grids"]
    if not isinstance(grids, dict) or not grids:
        raise UserError(f"{file}: grids must map names to grids, is {grids!r:.60}")
    built = tuple(_grid(file, name, content, base, Path(tree["data"])) for name, content in grids.items())
    known = [setting.name for setting in built[0].settings]
    headline = tree.get("headline")
    threads = tree.get("threads", 1)
    if type(threads) is not int or threads < 1:
        raise UserError(f"{file}: threads must be at least 1, is {threads!r}")
    return Suite(
        name=file.stem,
        title=str(tree.get("title", file.stem)),
        file=file,
        data=Path(tree["data"]),
        collect=_collect(file, tree.get("collect")),
        seeds=_seeds(file, "seeds", tree.get("seeds", [0, 1, 2, 3, 4])),
        tune_seeds=_seeds(file, "tune_seeds", tree.get("tune_seeds", [100, 101, 102])),
        threads=threads,
        probe=_check_keys(file, "probe", tree.get("probe") or {}, set(PROBE_OPTIONS)),
        slurm=_mapping(file, "slurm", tree.get("slurm")),
        grids=built,
        headline=tuple(_headline_row(file, *item, known) for item in _mapping(file, "headline", headline).items()),
        claims=tuple(_claim(file, *item, known) for item in _mapping(file, "claims", tree.get("claims")).items()),
        measures=_words(file, "measures", tree.get("measures", [])),
        curves=_words(file, "curves", tree.get("curves", ["train/loss"])),
        show=_words(file, "show", tree.get("show", []), known),
        colours=_words(file, "colours", tree.get("colours", [])),
    )


def _headline_row(file: Path, label: str, content: Any, settings: Sequence[str]) -> HeadlineRow:
    key = f"headline.{label}"
    _check_keys(file, key, content, {"measure", "paper"})
    paper = _mapping(file, f"{key}.paper", content.get("paper"))
    for setting, value in paper.items():
        _check_choice(file, f"{key}.paper", setting, settings)
        _check_number(file, f"{key}.paper.{setting}", value)
    return HeadlineRow(label, str(content.get("measure", "")), paper)


def _claim(file: Path, text: str, content: Any, settings: Sequence[str]) -> Claim:
    key = f"claims.{text}"
    _check_keys(file, key, content, set(Claim.__dataclass_fields__) - {"text"})
    for needed in ("setting", "measure"):
        if needed not in content:
            raise UserError(f"{file}: {key}.{needed} is missing")
    _check_choice(file, f"{key}.setting", content["setting"], settings)
    if "than" in content:
        _check_choice(file, f"{key}.than", content["than"], settings)
    _check_choice(file, f"{key}.of", content.get("of", "value"), ("value", "difference", "ratio"))
    _check_choice(file, f"{key}.judge", content.get("judge", "mean"), ("mean", "whole", "any"))
    bounds = [content[bound] for bound in ("at_most", "at_least") if content.get(bound) is not None]
    if not bounds:
        raise UserError(f"{file}: {key} needs at_most or at_least, a number to hold it against")
    for bound in bounds:
        _check_number(file, key, bound)
    return Claim(text, **content)


def _grid(file: Path, name: str, content: Any, base: Sequence[str], data: Path) -> Grid:
    key = f"grids.{name}"
    _check_name(file, key, name)
    _check_keys(file, key, content, {"about", "baseline", "with", "vary"})
    axes = content.get("vary")
    if not isinstance(axes, dict) or not axes or not all(isinstance(v, list) and v for v in axes.values()):
        raise UserError(f"{file}: {key}.vary must map keys to lists of values, is {axes!r:.80}")
    fixed = _mapping(file, f"{key}.with", content.get("with"))
    _check_options(file, f"{key}.with", fixed)
    _check_options(file, f"{key}.vary", axes)
    settings = []
    for values in itertools.product(*axes.values()):
        given = dict(zip(axes, values, strict=True))
        configs = [*base, *(_config(file, key, c) for part in (fixed, given) for c in _listed(part.get(CONFIG, [])))]
        options = {k: v for part in (fixed, given) for k, v in part.items() if k != CONFIG}
        options = {"data.path": str(data), **options}
        label = "-".join(_label(axis, value) for axis, value in given.items())
        settings.append(Setting(name, label, tuple(configs), options, _together(configs, options)))
    names = [setting.name for setting in settings]
    for label in names:
        _check_name(file, key, label)
        if names.count(label) > 1:
            raise UserError(f"{file}: {key} has two settings called '{label}'; give their files different names")
    baseline = str(content.get("baseline", names[0]))
    if baseline not in names:
        raise UserError(f"{file}: {key}.baseline: no setting is called '{baseline}' {nearest(baseline, names)}")
    return Grid(name, str(content.get("about", "")), baseline, tuple(settings))


def _together(configs: Sequence[str], options: Mapping[str, Any]) -> dict[str, Any]:
    tree: dict[str, Any] = {}
    for name in configs:
        path = configurations.resolve(name)
        tree = merged(tree, _mapping(path, "a configuration", yaml.safe_load(path.read_text())))
    for key, value in options.items():
        tree = with_option(tree, key, value)
    return tree


def _label(axis: str, value: Any) -> str:
    """bottleneck/none -> none; model.bottleneck.init_args.groups, 4 -> groups_4."""
    if axis == CONFIG:
        return "-".join(Path(str(item)).name.removesuffix(".yaml") for item in _listed(value))
    return f"{axis.rpartition('.')[2]}_{value}"


def _config(file: Path, key: str, name: Any) -> str:
    """A configuration named in a suite: a file beside the suite's, or what ``--config`` would take."""
    beside = file.parent / str(name)
    found = str(beside) if beside.is_file() else str(name)
    try:
        configurations.resolve(found)
    except UserError as error:
        raise UserError(f"{file}: {key}: {str(error).removeprefix('--config ')}") from error
    return found


def _collect(file: Path, given: Any) -> tuple[str, ...]:
    if given is not None and not isinstance(given, str):
        raise UserError(f"{file}: collect must be words of a collect command, such as robot_arm, is {given!r:.60}")
    return tuple((given or "").split())


def _check_options(file: Path, key: str, options: Mapping[Any, Any]) -> None:
    for option in options:
        if not isinstance(option, str):
            raise UserError(f"{file}: {key}: {option!r} is no dotted option of fit, such as model.shift")
        if option in SET_BY_SUITE:
            raise UserError(f"{file}: {key}: '{option}' follows from the suite's data and seeds; leave it out")


def _seeds(file: Path, key: str, given: Any) -> tuple[int, ...]:
    if not isinstance(given, list) or not given or not all(type(seed) is int and seed >= 0 for seed in given):
        raise UserError(f"{file}: {key} must be a list of seeds such as [0, 1, 2], is {given!r:.60}")
    if len(set(given)) < len(given):
        raise UserError(f"{file}: {key} names a seed twice: {given}")
    check_seeds(given, tune=key == "tune_seeds", where=f"{file}: {key}")
    return tuple(given)


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


def _listed(value: Any) -> list[Any]:
    return value if isinstance(value, list) else [value]


def _mapping(file: Path, key: str, value: Any) -> dict[str, Any]:
    if value is None:
        return {}
    if not isinstance(value, dict):
        raise UserError(f"{file}: {key} must map names to values, is {value!r:.60}")
    return value


def _words(file: Path, key: str, value: Any, choices: Sequence[str] | None = None) -> tuple[str, ...]:
    if not isinstance(value, list) or not all(isinstance(word, str) for word in value):
        raise UserError(f"{file}: {key} must be a list of words, is {value!r:.60}")
    for word in value:
        if choices is not None:
            _check_choice(file, key, word, choices)
    return tuple(value)


def _check_choice(file: Path, key: str, word: Any, choices: Sequence[str]) -> None:
    if word not in choices:
        raise UserError(f"{file}: {key}: '{word}' is not known {nearest(str(word), choices)}")


def _check_number(file: Path, key: str, value: Any) -> None:
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise UserError(f"{file}: {key} must be a number, is {value!r:.60}")


def _check_keys(file: Path, where: str, tree: Any, known: set[str]) -> dict[str, Any]:
    if not isinstance(tree, dict):
        raise UserError(f"{file}: {where or 'a suite'} must map keys to values, is {tree!r:.60}")
    for key in tree:
        if key not in known:
            full = f"{where}.{key}" if where else str(key)
            raise UserError(f"{file}: unknown key '{full}' {nearest(str(key), known)}")
    return tree


def _check_name(file: Path, key: str, name: Any) -> None:
    """Names become folders."""
    if not isinstance(name, str) or not re.fullmatch(r"[\w.+-]+", name) or name.startswith("."):
        raise UserError(f"{file}: {key}: {name!r:.60} cannot name a folder; use letters, digits, '_', '-', '+' and '.'")
