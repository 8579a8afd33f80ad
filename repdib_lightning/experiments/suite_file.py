"""Reads a suite from its YAML file."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import yaml

from repdib_lightning import configurations
from repdib_lightning.errors import UserError, nearest
from repdib_lightning.experiments.suite import PROBE_OPTIONS, Against, Claim, Grid, HeadlineRow, Suite
from repdib_lightning.experiments.suite_checks import (
    check_choice,
    check_keys,
    check_name,
    check_number,
    listed,
    mapping,
    words,
)
from repdib_lightning.experiments.suite_grids import (
    Common,
    read_collect,
    read_config,
    read_finetune,
    read_grid,
    read_seeds,
    read_store,
    with_probe_data,
)
from repdib_lightning.experiments.suite_measures import check_measures
from repdib_lightning.rl import FRESH_OPTIONS, GIVEN_OPTIONS


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
    check_keys(
        file,
        "",
        tree,
        {"base", "finetune", "probe_data", "probe_collect", *Suite.__dataclass_fields__} - {"name", "file"},
    )
    for key in ("base", "data", "grids"):
        if key not in tree:
            raise UserError(f"{file}: '{key}' is missing (needed: base, data, grids)")
    built = _grids(file, tree)
    known = [setting.name for setting in built[0].settings]
    headline = tree.get("headline")
    places = [setting.place for grid in built for setting in grid.settings]
    threads = tree.get("threads", 1)
    if type(threads) is not int or threads < 1:
        raise UserError(f"{file}: threads must be at least 1, is {threads!r}")
    suite = Suite(
        name=file.stem,
        title=str(tree.get("title", file.stem)),
        file=file,
        data=read_store(file, "data", tree["data"]),
        collect=read_collect(file, "collect", tree.get("collect")),
        seeds=read_seeds(file, "seeds", tree.get("seeds", [0, 1, 2, 3, 4])),
        tune_seeds=read_seeds(file, "tune_seeds", tree.get("tune_seeds", [100, 101, 102])),
        threads=threads,
        probe=check_keys(file, "probe", tree.get("probe") or {}, set(PROBE_OPTIONS)),
        slurm=mapping(file, "slurm", tree.get("slurm")),
        grids=built,
        headline=tuple(_headline_row(file, *item, built) for item in mapping(file, "headline", headline).items()),
        claims=tuple(_claim(file, *item, built) for item in mapping(file, "claims", tree.get("claims")).items()),
        measures=words(file, "measures", tree.get("measures", [])),
        overview=words(file, "overview", tree.get("overview", [])),
        curves=words(file, "curves", tree.get("curves", ["train/loss"])),
        show=_show(file, words(file, "show", tree.get("show", []), known), built[0]),
        colours=words(file, "colours", tree.get("colours", [])),
        finetune_curves=words(file, "finetune_curves", tree.get("finetune_curves", ["eval/success"])),
        films=words(file, "films", tree.get("films", []), places),
        against=tuple(_against(file, *item, built) for item in mapping(file, "against", tree.get("against")).items()),
        drawn_groups=words(file, "drawn_groups", tree.get("drawn_groups", []), places),
        recognised=words(file, "recognised", tree.get("recognised", []), places),
        maps=words(file, "maps", tree.get("maps", []), [s.name for grid in built for s in grid.settings]),
    )
    check_measures(suite)
    return suite


def _grids(file: Path, tree: Mapping[str, Any]) -> tuple[Grid, ...]:
    finetune = mapping(file, "finetune", tree.get("finetune"))
    read_finetune(file, "finetune", finetune)  # checked even where every grid has its own
    common = Common(
        base=tuple(read_config(file, "base", item) for item in listed(tree["base"])),
        data=read_store(file, "data", tree["data"]),
        collect=read_collect(file, "collect", tree.get("collect")),
        finetune=finetune,
    )
    common = with_probe_data(file, "", tree, common)
    grids = tree["grids"]
    if not isinstance(grids, dict) or not grids:
        raise UserError(f"{file}: grids must map names to grids, is {grids!r:.60}")
    built = tuple(read_grid(file, name, content, common) for name, content in grids.items())
    _check_unused_options(file, [finetune, *(content.get("finetune") or {} for content in grids.values())], built)
    made: dict[Path, Grid] = {}
    for grid in built:
        for store, command in grid.stores.items():
            first = made.setdefault(store, grid)
            if command != first.stores[store]:
                key = "collect" if store == grid.data else "probe_collect"
                raise UserError(
                    f"{file}: grids.{grid.name}.{key}: {store} is made by '{' '.join(first.stores[store])}' for grid "
                    f"'{first.name}'; give the stores different names"
                )
    return built


def _check_unused_options(file: Path, given: Sequence[Mapping[str, Any]], grids: Sequence[Grid]) -> None:
    """Options of a fresh encoder are for settings without pre-training, those of a given one for settings with it."""
    told = [options or {} for each in given for options in (each.get("with"), *(each.get("runs") or {}).values())]
    for options, pretrained, said in (
        (FRESH_OPTIONS, False, "a fresh encoder, and every setting is pre-trained"),
        (GIVEN_OPTIONS, True, "an encoder that is given, and no setting is pre-trained"),
    ):
        made = [setting.finetune for grid in grids for setting in grid.settings if setting.pretrained is pretrained]
        used = {option for finetune in made if finetune for run in finetune.runs.values() for option in run}
        for option in sorted({option for each in told for option in each} & set(options) - used):
            raise UserError(f"{file}: finetune: '{option}' is of {said}")


def _show(file: Path, names: tuple[str, ...], grid: Grid) -> tuple[str, ...]:
    for setting in grid.settings:
        if setting.name in names and not setting.pretrained:
            raise UserError(f"{file}: show: '{setting.name}' is not pre-trained, it has no latents to show")
    return names


def _headline_row(file: Path, label: str, content: Any, grids: Sequence[Grid]) -> HeadlineRow:
    key = f"headline.{label}"
    check_keys(file, key, content, {"measure", "paper", "grid"})
    settings = _settings_of(file, key, content, grids)
    paper = mapping(file, f"{key}.paper", content.get("paper"))
    for setting, value in paper.items():
        check_choice(file, f"{key}.paper", setting, settings)
        check_number(file, f"{key}.paper.{setting}", value)
    return HeadlineRow(label, str(content.get("measure", "")), paper, content.get("grid", ""))


def _against(file: Path, name: str, content: Any, grids: Sequence[Grid]) -> Against:
    key = f"against.{name}"
    check_name(file, key, name)
    check_keys(file, key, content, {"grid", "option", "measures"})
    for needed in ("grid", "option", "measures"):
        if needed not in content:
            raise UserError(f"{file}: {key}.{needed} is missing")
    check_choice(file, f"{key}.grid", content["grid"], [grid.name for grid in grids])
    made = Against(name, content["grid"], str(content["option"]), words(file, f"{key}.measures", content["measures"]))
    grid = next(grid for grid in grids if grid.name == made.grid)
    if len(set(grid.numbers(made.option).values())) < 2:
        raise UserError(
            f"{file}: {key}.option: no two settings of '{grid.name}' have different numbers as {made.option}"
        )
    return made


def _claim(file: Path, text: str, content: Any, grids: Sequence[Grid]) -> Claim:
    key = f"claims.{text}"
    check_keys(file, key, content, set(Claim.__dataclass_fields__) - {"text"})
    for needed in ("setting", "measure"):
        if needed not in content:
            raise UserError(f"{file}: {key}.{needed} is missing")
    settings = _settings_of(file, key, content, grids)
    check_choice(file, f"{key}.setting", content["setting"], settings)
    if "than" in content:
        check_choice(file, f"{key}.than", content["than"], settings)
    check_choice(file, f"{key}.of", content.get("of", "value"), ("value", "difference", "ratio"))
    check_choice(file, f"{key}.judge", content.get("judge", "mean"), ("mean", "whole", "any", "interval"))
    bounds = [content[bound] for bound in ("at_most", "at_least") if content.get(bound) is not None]
    if not bounds:
        raise UserError(f"{file}: {key} needs at_most or at_least, a number to hold it against")
    for bound in bounds:
        check_number(file, key, bound)
    return Claim(text, **content)


def _settings_of(file: Path, key: str, content: Mapping[str, Any], grids: Sequence[Grid]) -> list[str]:
    """Names of the settings of the grid that a claim or a row is about: the first one without ``grid``."""
    by_name = {grid.name: grid for grid in grids}
    grid = content.get("grid", grids[0].name)
    check_choice(file, f"{key}.grid", grid, list(by_name))
    return [setting.name for setting in by_name[grid].settings]
