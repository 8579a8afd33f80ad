"""Reads a suite from its YAML file."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import yaml

from repdib_lightning import configurations
from repdib_lightning.errors import UserError, nearest
from repdib_lightning.experiments.merging import merged, with_option
from repdib_lightning.experiments.suite import (
    CONFIG,
    PROBE_OPTIONS,
    SET_BY_SUITE,
    Claim,
    Grid,
    HeadlineRow,
    Setting,
    Suite,
    check_seeds,
)
from repdib_lightning.experiments.suite_checks import (
    check_choice,
    check_keys,
    check_name,
    check_number,
    listed,
    mapping,
    words,
)


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
    check_keys(file, "", tree, {"base", *Suite.__dataclass_fields__} - {"name", "file"})
    for key in ("base", "data", "grids"):
        if key not in tree:
            raise UserError(f"{file}: '{key}' is missing (needed: base, data, grids)")
    if not isinstance(tree["data"], str) or not tree["data"]:
        raise UserError(f"{file}: data must name a store, such as data/robot_arm.h5, is {tree['data']!r:.60}")
    base = [_config(file, "base", item) for item in listed(tree["base"])]
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
        probe=check_keys(file, "probe", tree.get("probe") or {}, set(PROBE_OPTIONS)),
        slurm=mapping(file, "slurm", tree.get("slurm")),
        grids=built,
        headline=tuple(_headline_row(file, *item, known) for item in mapping(file, "headline", headline).items()),
        claims=tuple(_claim(file, *item, known) for item in mapping(file, "claims", tree.get("claims")).items()),
        measures=words(file, "measures", tree.get("measures", [])),
        curves=words(file, "curves", tree.get("curves", ["train/loss"])),
        show=words(file, "show", tree.get("show", []), known),
        colours=words(file, "colours", tree.get("colours", [])),
    )


def _headline_row(file: Path, label: str, content: Any, settings: Sequence[str]) -> HeadlineRow:
    key = f"headline.{label}"
    check_keys(file, key, content, {"measure", "paper"})
    paper = mapping(file, f"{key}.paper", content.get("paper"))
    for setting, value in paper.items():
        check_choice(file, f"{key}.paper", setting, settings)
        check_number(file, f"{key}.paper.{setting}", value)
    return HeadlineRow(label, str(content.get("measure", "")), paper)


def _claim(file: Path, text: str, content: Any, settings: Sequence[str]) -> Claim:
    key = f"claims.{text}"
    check_keys(file, key, content, set(Claim.__dataclass_fields__) - {"text"})
    for needed in ("setting", "measure"):
        if needed not in content:
            raise UserError(f"{file}: {key}.{needed} is missing")
    check_choice(file, f"{key}.setting", content["setting"], settings)
    if "than" in content:
        check_choice(file, f"{key}.than", content["than"], settings)
    check_choice(file, f"{key}.of", content.get("of", "value"), ("value", "difference", "ratio"))
    check_choice(file, f"{key}.judge", content.get("judge", "mean"), ("mean", "whole", "any"))
    bounds = [content[bound] for bound in ("at_most", "at_least") if content.get(bound) is not None]
    if not bounds:
        raise UserError(f"{file}: {key} needs at_most or at_least, a number to hold it against")
    for bound in bounds:
        check_number(file, key, bound)
    return Claim(text, **content)


def _grid(file: Path, name: str, content: Any, base: Sequence[str], data: Path) -> Grid:
    key = f"grids.{name}"
    check_name(file, key, name)
    check_keys(file, key, content, {"about", "baseline", "with", "vary"})
    axes = content.get("vary")
    if not isinstance(axes, dict) or not axes or not all(isinstance(v, list) and v for v in axes.values()):
        raise UserError(f"{file}: {key}.vary must map keys to lists of values, is {axes!r:.80}")
    fixed = mapping(file, f"{key}.with", content.get("with"))
    _check_options(file, f"{key}.with", fixed)
    _check_options(file, f"{key}.vary", axes)
    settings = []
    for values in itertools.product(*axes.values()):
        given = dict(zip(axes, values, strict=True))
        configs = [*base, *(_config(file, key, c) for part in (fixed, given) for c in listed(part.get(CONFIG, [])))]
        options = {k: v for part in (fixed, given) for k, v in part.items() if k != CONFIG}
        options = {"data.path": str(data), **options}
        label = "-".join(_label(axis, value) for axis, value in given.items())
        settings.append(Setting(name, label, tuple(configs), options, _together(configs, options)))
    names = [setting.name for setting in settings]
    for label in names:
        check_name(file, key, label)
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
        tree = merged(tree, mapping(path, "a configuration", yaml.safe_load(path.read_text())))
    for key, value in options.items():
        tree = with_option(tree, key, value)
    return tree


def _label(axis: str, value: Any) -> str:
    """bottleneck/none -> none; model.bottleneck.init_args.groups, 4 -> groups_4."""
    if axis == CONFIG:
        return "-".join(Path(str(item)).name.removesuffix(".yaml") for item in listed(value))
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
