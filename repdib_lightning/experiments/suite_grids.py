"""Reads the grids of a suite's file: their settings, and the fine-tunings that follow."""

from __future__ import annotations

import importlib
import inspect
import itertools
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import yaml

from repdib_lightning import configurations
from repdib_lightning.errors import UserError, nearest
from repdib_lightning.experiments.merging import merged, with_option
from repdib_lightning.experiments.snapshots import check_names, check_snapshots, read_snapshots
from repdib_lightning.experiments.suite import (
    CONFIG,
    PROBE_OPTIONS,
    SET_BY_SUITE,
    SNAPSHOT,
    SNAPSHOTS,
    Finetune,
    Grid,
    Setting,
    check_seeds,
    explores,
)
from repdib_lightning.experiments.suite_checks import check_choice, check_keys, check_name, listed, mapping
from repdib_lightning.rl import AGENTS

PRETRAINED = "pretrained"
"""Key of a setting: false for one without pre-training."""

SET_FOR_FINETUNE = ("seed", "encoder", "run", "overwrite", "resume", "data", SNAPSHOT)
"""Options of ``finetune`` that follow from the point, or from the suite's list of snapshots."""

PLACES = ("task", "env")
"""Options of ``finetune`` that say where an agent acts; one of them is needed."""


@dataclass(frozen=True)
class Common:
    """What the grids of a suite share unless they say otherwise.

    Attributes:
        base: configurations. data: the store. collect: words of the command that makes it. finetune: as in the file.
        probe_data, probe_collect: the store for probing alone, where there is one, and what makes it.
    """

    base: tuple[str, ...]
    data: Path
    collect: tuple[str, ...]
    finetune: Mapping[str, Any]
    probe_data: Path | None = None
    probe_collect: tuple[str, ...] = ()


def read_grid(file: Path, name: str, content: Any, common: Common) -> Grid:
    """One grid. Raises UserError naming the file and the key."""
    key = f"grids.{name}"
    check_name(file, key, name)
    known = {"about", "baseline", "with", "vary", "settings", "finetune", "seeds", "probe"}
    known |= {"data", "collect", "probe_data", "probe_collect"}
    check_keys(file, key, content, known)
    own = _own(file, key, content, common)
    named = f"{key}.finetune" if content.get("finetune") else "finetune"
    finetune = read_finetune(file, named, own.finetune)
    if finetune is not None and learns_from_data(finetune.agent):
        told = {run: {"data": str(own.data), **options} for run, options in finetune.runs.items()}
        finetune = replace(finetune, runs=told)
    fixed = mapping(file, f"{key}.with", content.get("with"))
    _check_options(file, f"{key}.with", fixed)
    if PRETRAINED in fixed:
        raise UserError(f"{file}: {key}: '{PRETRAINED}' is said of a single one, as {key}.settings.NAME.{PRETRAINED}")
    if "settings" in content and "vary" in content:
        raise UserError(f"{file}: {key} has both 'vary' and 'settings'; leave one of them out")
    cells = _named(file, key, content) if "settings" in content else _varied(file, key, content)
    settings: list[Setting] = []
    for label, given in cells:
        check_name(file, key, label)
        if any(setting.name == label for setting in settings):
            raise UserError(f"{file}: {key} has two settings called '{label}'; give their files different names")
        made = _setting(file, key, Setting(name, label, (), {}, {}, finetune=finetune), (fixed, given), own)
        settings.append(_from_snapshots(file, content, made, own))
    names = [setting.name for setting in settings]
    baseline = str(content.get("baseline", names[0]))
    if baseline not in names:
        raise UserError(f"{file}: {key}.baseline: no setting is called '{baseline}', {nearest(baseline, names)}")
    seeds = read_seeds(file, f"{key}.seeds", content["seeds"]) if "seeds" in content else ()
    about = str(content.get("about", ""))
    probe = check_keys(file, f"{key}.probe", content["probe"], set(PROBE_OPTIONS)) if "probe" in content else None
    stores = {field: getattr(own, field) for field in ("data", "collect", "probe_data", "probe_collect")}
    return Grid(name, about, baseline, tuple(settings), seeds=seeds, probe=probe, **stores)


def read_store(file: Path, key: str, given: Any) -> Path:
    """A store's path."""
    if not isinstance(given, str) or not given:
        raise UserError(f"{file}: {key} must name a store, such as data/robot_arm.h5, is {given!r:.60}")
    return Path(given)


def read_collect(file: Path, key: str, given: Any) -> tuple[str, ...]:
    """Words of a ``collect`` command."""
    if given is not None and not isinstance(given, str):
        raise UserError(f"{file}: {key} must be words of a collect command, such as robot_arm, is {given!r:.60}")
    return tuple(shlex.split(given or ""))


def read_seeds(file: Path, key: str, given: Any) -> tuple[int, ...]:
    """Seeds as a file lists them: of development under ``tune_seeds``, else reported ones."""
    if not isinstance(given, list) or not given or not all(type(seed) is int and seed >= 0 for seed in given):
        raise UserError(f"{file}: {key} must be a list of seeds such as [0, 1, 2], is {given!r:.60}")
    if len(set(given)) < len(given):
        raise UserError(f"{file}: {key} names a seed twice: {given}")
    check_seeds(given, tune=key == "tune_seeds", where=f"{file}: {key}")
    return tuple(given)


def read_config(file: Path, key: str, name: Any) -> str:
    """A configuration named in a suite: a file beside the suite's, or what ``--config`` would take."""
    beside = file.parent / str(name)
    found = str(beside) if beside.is_file() else str(name)
    try:
        configurations.resolve(found)
    except UserError as error:
        raise UserError(f"{file}: {key}: {str(error).removeprefix('--config ')}") from error
    return found


def read_finetune(file: Path, key: str, content: Mapping[str, Any]) -> Finetune | None:
    """Fine-tunings as a file says them; None where there are none."""
    check_keys(file, key, dict(content), {"agent", "with", "runs", SNAPSHOTS})
    snapshots = read_snapshots(file, f"{key}.{SNAPSHOTS}", content.get(SNAPSHOTS))
    shared = mapping(file, f"{key}.with", content.get("with"))
    given = mapping(file, f"{key}.runs", content.get("runs"))
    if not given:
        return None
    if not isinstance(content.get("agent"), str):
        raise UserError(f"{file}: {key}.agent must name an agent, such as dqn, is {content.get('agent')!r:.60}")
    agent = content["agent"]
    check_choice(file, f"{key}.agent", agent, list(AGENTS))
    if snapshots and SNAPSHOT not in _parameters(agent):
        raise UserError(f"{file}: {key}.{SNAPSHOTS}: '{agent}' takes no snapshots of an exploration; leave them out")
    known = _options_of(agent)
    place = next((option for option in PLACES if option in known), "")
    _check_finetune_options(file, f"{key}.with", shared, known)
    runs: dict[str, dict[str, Any]] = {}
    for name, own in given.items():
        check_name(file, f"{key}.runs", name)
        options = mapping(file, f"{key}.runs.{name}", own)
        _check_finetune_options(file, f"{key}.runs.{name}", options, known)
        runs[name] = {**shared, **options}
        if place and not learns_from_data(agent) and not isinstance(runs[name].get(place), str):
            such = {"env": "an environment, such as SpiralWorld", "task": "a task, such as walker-run"}[place]
            raise UserError(f"{file}: {key}.runs.{name}.{place} must name {such}")
    check_names(file, f"{key}.runs", list(runs), snapshots)
    return Finetune(agent, runs)


def learns_from_data(agent: str) -> bool:
    """Whether an agent takes a store: the one of its setting's grid."""
    return "data" in _parameters(agent)


def _own(file: Path, key: str, content: Mapping[str, Any], common: Common) -> Common:
    """The suite's choices with those of one grid over them. Another store is not made by the suite's command."""
    if content.get("data") is not None:
        data = read_store(file, f"{key}.data", content["data"])
        common = replace(common, data=data, collect=common.collect if data == common.data else ())
    if content.get("collect") is not None:
        common = replace(common, collect=read_collect(file, f"{key}.collect", content["collect"]))
    common = with_probe_data(file, f"{key}.", content, common)
    finetune = mapping(file, f"{key}.finetune", content.get("finetune"))
    return replace(common, finetune={**common.finetune, **finetune})


def with_probe_data(file: Path, where: str, content: Mapping[str, Any], common: Common) -> Common:
    """With what a file, or a grid of it, says of a store for probing."""
    if content.get("probe_data") is not None:
        data = read_store(file, f"{where}probe_data", content["probe_data"])
        kept = common.probe_collect if data == common.probe_data else ()
        common = replace(common, probe_data=data, probe_collect=kept)
    if content.get("probe_collect") is not None:
        if common.probe_data is None:
            raise UserError(f"{file}: {where}probe_collect makes a store that is not named; add probe_data")
        words = read_collect(file, f"{where}probe_collect", content["probe_collect"])
        common = replace(common, probe_collect=words)
    return common


def _varied(file: Path, key: str, content: Mapping[str, Any]) -> list[tuple[str, dict[str, Any]]]:
    """Every combination: name -> what it says."""
    axes = content.get("vary")
    if not isinstance(axes, dict) or not axes or not all(isinstance(v, list) and v for v in axes.values()):
        raise UserError(f"{file}: {key}.vary must map keys to lists of values, is {axes!r:.80}")
    _check_options(file, f"{key}.vary", axes)
    if PRETRAINED in axes:
        raise UserError(f"{file}: {key}.vary: '{PRETRAINED}' cannot vary; name the settings under {key}.settings")
    given = [dict(zip(axes, values, strict=True)) for values in itertools.product(*axes.values())]
    return [("-".join(_label(axis, value) for axis, value in cell.items()), cell) for cell in given]


def _named(file: Path, key: str, content: Mapping[str, Any]) -> list[tuple[str, dict[str, Any]]]:
    """The settings that are written out: name -> what it says."""
    named = content["settings"]
    if not isinstance(named, dict) or not named:
        raise UserError(f"{file}: {key}.settings must map names to settings, is {named!r:.80}")
    cells = [(name, mapping(file, f"{key}.settings.{name}", given)) for name, given in named.items()]
    for name, given in cells:
        _check_options(file, f"{key}.settings.{name}", given)
    return cells


def _setting(file: Path, key: str, bare: Setting, parts: Sequence[Mapping[str, Any]], own: Common) -> Setting:
    fixed, given = parts
    if not _is_pretrained(file, f"{key}.settings.{bare.name}", given, bare):
        assert bare.finetune is not None
        data = own.data if learns_from_data(bare.finetune.agent) else None
        return replace(bare, pretrained=False, data=data, finetune=bare.finetune.from_scratch())
    given = {option: value for option, value in given.items() if option != PRETRAINED}
    configs = [*own.base, *(read_config(file, key, c) for part in (fixed, given) for c in listed(part.get(CONFIG, [])))]
    options = {k: v for part in (fixed, given) for k, v in part.items() if k != CONFIG}
    if not explores(_together(configs, options)):  # which makes its data itself
        options = {"data.path": str(own.data), **options}
    together = _together(configs, options)
    finetune = None if bare.finetune is None else bare.finetune.of_an_encoder()
    on_data = replace(bare, data=own.data, probe_data=own.probe_data)
    return replace(on_data, configs=tuple(configs), options=options, merged=together, finetune=finetune)


def _from_snapshots(file: Path, content: Mapping[str, Any], setting: Setting, own: Common) -> Setting:
    """The setting with its fine-tunings from every snapshot; without pre-training it has none."""
    if not setting.pretrained or setting.finetune is None:
        return setting
    listed_here = SNAPSHOTS in (content.get("finetune") or {})
    key = f"grids.{setting.grid}.finetune.{SNAPSHOTS}" if listed_here else f"finetune.{SNAPSHOTS}"
    frames = read_snapshots(file, key, own.finetune.get(SNAPSHOTS))
    check_snapshots(file, key, frames, setting.place, setting.merged)
    return replace(setting, finetune=setting.finetune.from_snapshots(frames))


def _is_pretrained(file: Path, key: str, given: Mapping[str, Any], bare: Setting) -> bool:
    told = given.get(PRETRAINED, True)
    if not isinstance(told, bool):
        raise UserError(f"{file}: {key}.{PRETRAINED} must be true or false, is {told!r:.60}")
    if told:
        return True
    for option in given:
        if option != PRETRAINED:
            raise UserError(f"{file}: {key}: '{option}' means nothing without pre-training; leave it out")
    if bare.finetune is None:
        raise UserError(f"{file}: {key}: neither pre-trained nor fine-tuned; add 'finetune' with runs, or leave it out")
    return False


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


_PARTS_OF_FIT = ("checkpoint_every", "checkpoint_keep", CONFIG, "data", "model", "pretrained", "trainer")
"""What the first word of an option may be."""


def _check_options(file: Path, key: str, options: Mapping[Any, Any]) -> None:
    for option in options:
        if not isinstance(option, str):
            raise UserError(f"{file}: {key}: {option!r} is no dotted option of fit, such as model.shift")
        if option.partition(".")[0] not in _PARTS_OF_FIT and option not in SET_BY_SUITE:
            raise UserError(f"{file}: {key}: '{option}' is not known, {nearest(option, _PARTS_OF_FIT)}")
        if option in SET_BY_SUITE:
            raise UserError(f"{file}: {key}: '{option}' follows from the suite's data and seeds; leave it out")


def _options_of(agent: str) -> list[str]:
    """Options of ``finetune AGENT`` that a suite may give."""
    return [name for name in _parameters(agent) if name not in SET_FOR_FINETUNE]


def _parameters(agent: str) -> list[str]:
    module, _, function = AGENTS[agent].partition(":")
    return list(inspect.signature(getattr(importlib.import_module(module), function)).parameters)


def _check_finetune_options(file: Path, key: str, options: Mapping[Any, Any], known: Sequence[str]) -> None:
    for option in options:
        if not isinstance(option, str):
            raise UserError(f"{file}: {key}: {option!r} is no option of finetune, such as steps")
        if option == SNAPSHOT:
            raise UserError(f"{file}: {key}: '{option}' is one of several; list them as {SNAPSHOTS} beside 'runs'")
        other = next((place for place in PLACES if place in known), "")
        if option in PLACES and option not in known and other:
            raise UserError(f"{file}: {key}: '{option}' is not known; this agent takes '{other}'")
        if option in SET_FOR_FINETUNE:
            raise UserError(f"{file}: {key}: '{option}' follows from the suite's seeds and runs; leave it out")
        check_choice(file, key, option.partition(".")[0], known)
