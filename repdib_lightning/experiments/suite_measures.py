"""Checks probes and names of measures in a suite's file, as far as they are known before anything ran."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from repdib_lightning.errors import UserError, nearest
from repdib_lightning.experiments.merging import REPLACED
from repdib_lightning.experiments.snapshots import ALL, MONOTONE
from repdib_lightning.experiments.suite import Grid, HeadlineRow, Suite
from repdib_lightning.word_lists import words

FACTOR_PROBES, PICTURE_PROBE, GROUP_PROBE, RECOGNITION_PROBE = ("linear", "mlp"), "decoder", "groups", "recognition"
"""What ``probe --probes`` takes; written out, since the probes themselves import torch."""

QUANTITIES = {**dict.fromkeys(FACTOR_PROBES, ("kept", "error")), PICTURE_PROBE: ("kept", "error", "rmse")}
"""Probe -> last part of its measures."""

GROUP_SCORES = (
    *("modularity", "compactness", "explicitness", "mig", "held"),
    *("dci_disentanglement", "dci_completeness", "dci_informativeness"),
    *("psnr", "psnr_gain", "psnr_lost_most", "psnr_lost_least"),
)
GROUP_FACTOR_SCORES = ("share", "share_gap", "explicitness", "judged", "drawn", "moved", "moved_gap", "moved_unswapped")
"""What the probe ``groups`` measures of a latent, and of each factor."""

RECOGNITION_SCORES = ("f1_macro", "f1_micro", "f1_weighted", "accuracy")
RECOGNITION_PARTS = ("f1", "without", "only", "weight", "perplexity")
"""What the probe ``recognition`` measures, and of each activity or modality."""

QUANTISERS = ("VectorQuantiser", "RepDIB")
"""Bottlenecks that take ``groups``; written out, since they import torch."""


def check_measures(suite: Suite) -> None:
    """Check ``probe``, and probes, agents and names of fine-tunings in ``measures``, ``claims`` and ``headline``.

    Factors, logged values and what an agent measures show only when there are results.

    Raises:
        UserError: naming file, key and the nearest name, or the setting that has other groups than its probe.
    """
    _check_probes(suite)
    _check_shared_probes(suite)
    _check_groups(suite)
    for measure in suite.measures:
        _check(suite, "measures", measure, suite.grids)
    for measure in suite.overview:
        _check(suite, "overview", measure, suite.grids)
    for entry in suite.against:
        for measure in entry.measures:
            _check(suite, f"against.{entry.name}.measures", measure, [suite.grid(entry.grid)])
    for claim in suite.claims:
        _check(suite, f"claims.{claim.text}.measure", claim.measure, [suite.grid(claim.grid)])
    for row in suite.headline:
        _check_headline(suite, row)


def is_whole(measure: str) -> bool:
    """Whether a measure is one number of a point, and not a probe's two readings of a factor."""
    first, last = str(measure).partition("/")[0], str(measure).rpartition("/")[2]
    return first not in QUANTITIES or last in QUANTITIES[first]


def _check_headline(suite: Suite, row: HeadlineRow) -> None:
    whole = is_whole(row.measure)
    if row.grid and not whole:
        raise UserError(
            f"{suite.file}: headline.{row.label}.grid: '{row.measure}' is read relative to the baseline of the first "
            f"grid; leave 'grid' out, or name a whole measure such as {row.measure}/kept"
        )
    measure = row.measure if whole else f"{row.measure}/kept"
    _check(suite, f"headline.{row.label}.measure", measure, [suite.grid(row.grid)])


def probes_of(suite: Suite, grid: Grid) -> tuple[str, ...]:
    """Names of the probes that every pre-trained point of a grid is read by."""
    own = suite.probe if grid.probe is None else grid.probe
    return words(own.get("probes", FACTOR_PROBES), f"{suite.file}: probe.probes")


def _check_probes(suite: Suite) -> None:
    known = (*FACTOR_PROBES, PICTURE_PROBE, GROUP_PROBE, RECOGNITION_PROBE)
    for grid in suite.grids:
        chosen = probes_of(suite, grid)
        where = f"{suite.file}: " + ("probe.probes" if grid.probe is None else f"grids.{grid.name}.probe.probes")
        for name in chosen:
            if name not in known:
                raise UserError(f"{where}: '{name}' is not known, {nearest(name, known)}")
        if not set(chosen) & set(FACTOR_PROBES):
            raise UserError(f"{where}: one of {', '.join(FACTOR_PROBES)} is needed")


def _check_shared_probes(suite: Suite) -> None:
    """A run that several grids share is probed as the first of them says."""
    for grid in suite.grids:
        for setting in grid.settings:
            first = suite.grid(suite.run_by(setting).grid)
            missing = [name for name in probes_of(suite, grid) if name not in probes_of(suite, first)]
            if setting.pretrained and missing:
                raise UserError(
                    f"{suite.file}: grids.{grid.name}: '{setting.name}' is run once, for grid '{first.name}', whose "
                    f"probes lack '{missing[0]}'; add it there"
                )


def _check_groups(suite: Suite) -> None:
    """A quantised latent cannot be cut into other groups than its own; the probe would say so after training."""
    for grid in suite.grids:
        probe, key = (suite.probe, "probe") if grid.probe is None else (grid.probe, f"grids.{grid.name}.probe")
        wanted = probe.get("groups")
        for setting in grid.settings:
            own = _groups_of(_under(setting.merged.get("model"), "bottleneck"))
            if None not in (wanted, own) and str(wanted) != str(own):
                raise UserError(
                    f"{suite.file}: {key}.groups is {wanted}, but '{setting.place}' quantises {own} groups; set {own}, "
                    f"or leave it out, in a 'probe' of a grid of its own"
                )


def _groups_of(bottleneck: Any) -> Any:
    """``groups`` of a bottleneck's block, as far as files and options say it; None where they do not."""
    given = _under(_under(bottleneck, "init_args"), "groups")
    if given is None and str(_under(bottleneck, "class_path")).rpartition(".")[2] in QUANTISERS:
        return _groups_of(_under(bottleneck, REPLACED))  # the parser takes over what the new class has too
    return given


def _under(block: Any, key: str) -> Any:
    return block.get(key) if isinstance(block, Mapping) else None


def _check(suite: Suite, key: str, measure: str, grids: Sequence[Grid]) -> None:
    first, _, rest = str(measure).partition("/")
    settings = [setting for grid in grids for setting in grid.settings]
    finetunes = [setting.finetune for setting in settings if setting.finetune is not None]
    probes = [name for grid in grids for name in probes_of(suite, grid)]
    probed = (*probes, "codes", "val") if any(setting.pretrained for setting in settings) else ()
    explored = ("explore",) if any(setting.explores for setting in settings) else ()
    known = {*probed, *explored, *(finetune.agent for finetune in finetunes)}
    where = f"{suite.file}: {key}: '{measure}'"
    if first not in known:
        raise UserError(f"{where}: '{first}' is no probe or agent here, {nearest(first, known)}")
    of_agent = [finetune for finetune in finetunes if finetune.agent == first]
    runs = {name for finetune in of_agent for name in (*finetune.runs, *finetune.snapshots)}
    name, _, of_run = rest.partition("/")
    if (name, of_run) == (ALL, MONOTONE) and any(finetune.snapshots for finetune in of_agent):
        return
    if runs and name not in runs:
        raise UserError(f"{where}: no fine-tuning is called '{name}', {nearest(name, runs)}")
    if runs and not of_run:
        raise UserError(f"{where}: does not say what of the fine-tuning, such as {first}/{name}/mean_return")
    last = rest.rpartition("/")[2]
    if first == GROUP_PROBE:
        kind, known_last = ("of a factor ", GROUP_FACTOR_SCORES) if "/" in rest else ("", GROUP_SCORES)
        if last not in known_last:
            raise UserError(f"{where}: '{last}' {kind}is not measured, {nearest(last, known_last)}")
    if first == RECOGNITION_PROBE:
        kind, known_first = ("of a class or modality ", RECOGNITION_PARTS) if "/" in rest else ("", RECOGNITION_SCORES)
        if name not in known_first:
            raise UserError(f"{where}: '{name}' {kind}is not measured, {nearest(name, known_first)}")
    if first in QUANTITIES and last not in QUANTITIES[first]:
        raise UserError(f"{where}: must end in {' or '.join(QUANTITIES[first])}, {nearest(last, QUANTITIES[first])}")
