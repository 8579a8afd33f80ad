"""``inspect``: what is in a data file, and what is wrong with it."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import h5py
import numpy as np

from repdib_lightning.data.clip_report import describe_clips
from repdib_lightning.data.clips import is_clip
from repdib_lightning.data.contact_sheet import draw_contact_sheet
from repdib_lightning.data.episodes import EpisodeStore
from repdib_lightning.data.findings import (
    acted,
    acting_rows,
    layout_of,
    slow_layouts,
    suspicious_content,
)
from repdib_lightning.data.fingerprint import recompute_fingerprint
from repdib_lightning.data.foreign import describe_foreign
from repdib_lightning.data.inspection_text import bar, file_size, short_number, spread, table
from repdib_lightning.data.outputs import check_output_file
from repdib_lightning.data.partial import describe_unfinished
from repdib_lightning.errors import UserError

_MOST_LISTED, _LARGEST_SAMPLE = 12, 2**26


@dataclass(frozen=True)
class Inspection:
    """What was found.

    Attributes:
        text: the report without its warnings.
        warnings: one line each, with what to do.
        contact_sheet: the picture that was written; None for data of other programs.
    """

    text: str
    warnings: list[str] = field(default_factory=list)
    contact_sheet: Path | None = None

    def __str__(self) -> str:
        lines = [self.text, *(f"warning: {warning}" for warning in self.warnings)]
        if self.contact_sheet is not None:
            lines.append(f"contact sheet: {self.contact_sheet}")
        return "\n".join(lines)


def inspect_store(path: Path, *, contact_sheet: Path | None = None, verify: bool = False) -> Inspection:
    """Describe a store: schema, layout, counts, ranges, factors, warnings; and draw a contact sheet.

    Data of other programs are named, with the command that converts them; an unfinished recording is one line.

    Args:
        path: the store; or a file or folder of another format.
        contact_sheet: where to write the PNG (.png); default: beside the store, under its name.
        verify: hash the whole content again and compare with the fingerprint that was written with it.

    Returns:
        The report; ``str()`` of it is what the command line prints.

    Raises:
        UserError: naming file, key and episode: missing, truncated, not a store, arrays that disagree; or the content
            does not match its fingerprint. Or a contact sheet that is no .png, the store itself or cannot be written.
    """
    path = Path(path)
    if contact_sheet is not None:
        check_output_file(Path(contact_sheet), "--contact_sheet", ".png", [path])
    other = describe_unfinished(path) or describe_foreign(path)
    if other is not None:
        return Inspection(other)
    if path.is_dir():
        raise UserError(f"{path}: a folder in which no import finds its files (expected: *.npz, *.hdf5 or a *.csv)")
    store = EpisodeStore(path)
    checked = _verify(store) if verify else ""
    samples = _sample(store)
    text = "\n".join(
        [
            *_head(store, checked),
            *_keys(store, samples),
            *_actions(store),
            *_rewards(store),
            *_factors(store),
            *describe_clips(store),
        ]
    )
    warnings = slow_layouts(store) + suspicious_content(store, samples)
    try:
        place = Path(contact_sheet or path.with_suffix(".png"))
        check_output_file(place, "--contact_sheet", ".png", [path])
        sheet = draw_contact_sheet(store, place)
    except UserError as error:
        if contact_sheet is not None:
            raise
        return Inspection(text, [*warnings, f"no contact sheet: {error}; pass --contact_sheet PATH"])
    return Inspection(text, warnings, sheet)


def _verify(store: EpisodeStore) -> str:
    if not store.fingerprint:
        raise UserError(f"{store.path}: has no fingerprint to verify (another program wrote it)")
    found = recompute_fingerprint(store, progress=True)
    if found != store.fingerprint:
        raise UserError(
            f"{store.path}: the content ({found}) does not match its fingerprint ({store.fingerprint}); "
            "it was changed or damaged since it was written"
        )
    return " (verified)"


def _sample(store: EpisodeStore) -> dict[str, np.ndarray]:
    """Observation -> (n, ...) of evenly spread rows; few where each costs the decoding of a chunk."""
    samples = {}
    for name in store.observations:
        key = f"observations/{name}"
        wanted = 256 if isinstance(store.array(key), np.memmap) else 16
        if is_clip(store, name):
            wanted = min(wanted, max(16, _LARGEST_SAMPLE // store.array(key)[0].nbytes))
        rows = np.unique(np.linspace(0, store.rows - 1, wanted).astype(np.int64))
        samples[name] = store.gather(key, rows)
    return samples


def _head(store: EpisodeStore, checked: str) -> list[str]:
    stored = bool(store.evaluation.any())
    held_out = len(store.episodes("evaluation"))
    facts = {
        "size": file_size(store.path.stat().st_size),
        "fingerprint": (store.fingerprint or "none (written by another program)") + checked,
        "rows": _rows(store),
        "episodes": f"{len(store.lengths):,}; length: {spread(store.lengths)}",
        "evaluation": f"{held_out} episodes, {'as stored' if stored else 'every fifth (none is marked in the file)'}",
    }
    hidden = ("format", "fingerprint", "schema_version")
    facts |= {key: str(value) for key, value in sorted(store.attributes.items()) if key not in hidden}
    title = f"{store.path}: episodes, schema {store.attributes['schema_version']}"
    return [title, *table([[key, _shorten(value)] for key, value in facts.items()])]


def _rows(store: EpisodeStore) -> str:
    acting = len(acting_rows(store))
    with_actions = f" ({acting:,} with an action, one final observation an episode)" if acting else ""
    return f"{store.rows:,}{with_actions}"


def _shorten(text: str, width: int = 100) -> str:
    line = " ".join(text.split())
    return line if len(line) <= width else line[: width - 1] + "…"


def _keys(store: EpisodeStore, samples: dict[str, np.ndarray]) -> list[str]:
    rows = [["key", "shape", "type", "layout", "range (sampled)"]]

    def add(name: str, item: h5py.Dataset | h5py.Group) -> None:
        if isinstance(item, h5py.Dataset):
            observation = name.removeprefix("observations/")
            values = samples.get(observation) if name.startswith("observations/") else None
            if values is not None and store.observations[observation].is_sequence:
                values = values[np.isfinite(values)]
            shown = "" if values is None else _range(values) if values.size else "nothing observed"
            rows.append([name, " x ".join(map(str, item.shape)), str(item.dtype), layout_of(item), shown])

    with h5py.File(store.path, "r") as file:
        file.visititems(add)
    return ["", *table(rows)]


def _range(values: np.ndarray) -> str:
    return f"{short_number(values.min())} to {short_number(values.max())}, mean {short_number(values.mean())}"


def _actions(store: EpisodeStore) -> list[str]:
    spec = store.actions_spec
    if spec is None or not len(acting_rows(store)):
        return ["", "actions: none"]
    actions = acted(store, "actions")
    if spec.kind == "discrete":
        shares = np.bincount(actions, minlength=spec.size) / len(actions)
        rows = [[str(action), f"{share:6.1%}", bar(share)] for action, share in enumerate(shares[:_MOST_LISTED])]
        return ["", f"actions: discrete, {spec.size} choices{_rest(spec.size)}", *table(rows)]
    rows = [["dimension", "min", "mean", "max", "standard deviation"]]
    for index, values in enumerate(actions.T[:_MOST_LISTED]):
        numbers = (values.min(), values.mean(), values.max(), values.std())
        rows.append([str(index), *(short_number(number) for number in numbers)])
    return ["", f"actions: continuous, {spec.size} dimensions{_rest(spec.size)}", *table(rows)]


def _rest(count: int) -> str:
    return f" (the first {_MOST_LISTED})" if count > _MOST_LISTED else ""


def _rewards(store: EpisodeStore) -> list[str]:
    with h5py.File(store.path, "r") as file:
        present = {name for name in ("rewards", "terminations", "truncations") if name in file}
    if "rewards" not in present:
        return ["", "rewards: none"]
    rewards = np.array(store.array("rewards")[:], np.float64)
    rewards[store.starts + store.lengths - 1] = 0
    returns = np.add.reduceat(rewards, store.starts)
    lines = ["", f"rewards: a step: {_range(acted(store, 'rewards'))}; an episode's sum: {spread(returns)}"]
    ends = [f"{int(acted(store, name).sum())} {name}" for name in ("terminations", "truncations") if name in present]
    return [*lines, f"  ends: {', '.join(ends)}"] if ends else lines


def _factors(store: EpisodeStore) -> list[str]:
    if not store.factors:
        return ["", "factors: none"]
    rows = [["factor", "kind", "scale", "values"]]
    for name, spec in store.factors.items():
        values = np.asarray(store.array(f"factors/{name}")[:])
        if spec.scale == "categorical":
            shown = f"{len(np.unique(values))} of {spec.classes} classes occur"
        else:
            shown = f"{short_number(values.min())} to {short_number(values.max())}" + (
                f", {spec.width} dimensions" if spec.width > 1 else ""
            )
        rows.append([name, spec.kind, spec.scale, shown])
    return ["", "factors:", *table(rows)]
