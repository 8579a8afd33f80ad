"""Rewrites a store of our own schema whose arrays are chunked or compressed into contiguous, mappable ones."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import h5py
import numpy as np
from tqdm import tqdm

from repdib_lightning.data.copies import kept_attributes
from repdib_lightning.data.episodes import EpisodeStore
from repdib_lightning.data.sequential import SequentialRows
from repdib_lightning.data.writer import EpisodeWriter
from repdib_lightning.errors import UserError


def import_store(source: Path, output: Path, *, overwrite: bool = False, progress: bool = True) -> Path:
    """Copy a store into the native layout: contiguous, uncompressed, every value as it was.

    Args:
        source: a store (.h5) of any layout: the schema's keys, however chunked or compressed.
        output: the store to write.
        overwrite: replace an existing output.
        progress: show a progress bar.

    Returns:
        The output.

    Raises:
        UserError: the source is not a valid store, holds keys that the schema does not know, or cannot be decoded.
    """
    source, output = Path(source), Path(output)
    store = EpisodeStore(source)
    with h5py.File(source, "r") as file:
        columns = _columns(source, file)
        masks = {name: (file[f"masks/{name}"].shape[1], width) for name, width in store.masks.items()}
        writer = EpisodeWriter(
            output,
            rows=store.rows,
            episodes=len(store.lengths),
            observations=store.observations,
            actions=store.actions_spec,
            factors=store.factors,
            masks=masks,
            rewards="rewards" in columns,
            attributes=kept_attributes(store),
            recordings="episodes/recording" in store,
            overwrite=overwrite,
        )
        with writer, tqdm(total=store.rows, desc="import", unit="row", disable=not progress) as bar:
            for episode in range(len(store.lengths)):
                start, length = int(store.starts[episode]), int(store.lengths[episode])
                rows = {name: column.read(start, start + length) for name, column in columns.items()}
                held_out, recording = bool(store.evaluation[episode]), store.recording_of(episode)
                writer.add_episode(**_arguments(rows, store.masks), evaluation=held_out, recording=recording)
                bar.update(length)
    return output


def _columns(source: Path, file: h5py.File) -> dict[str, SequentialRows]:
    """Every array of the schema; a key that would be lost is refused."""
    names: list[str] = []
    file.visititems(lambda name, item: names.append(name) if isinstance(item, h5py.Dataset) else None)
    known = ("observations/", "factors/", "masks/", "episodes/")
    outcome = {"rewards", "terminations", "truncations"}
    for name in names:
        if not name.startswith(known) and name not in {"actions", *outcome}:
            raise UserError(
                f"{source}: key '{name}' is not part of the schema; remove it, or rename it to factors/{name}"
            )
    missing = outcome - set(names)
    if 0 < len(missing) < len(outcome):
        raise UserError(
            f"{source}: key '{min(missing)}' is missing; rewards, terminations and truncations come together"
        )
    return {name: SequentialRows(file[name]) for name in names if not name.startswith("episodes/")}


def _arguments(rows: dict[str, np.ndarray], mask_widths: dict[str, int]) -> dict[str, Any]:
    """Rows of one episode, by key, as the writer wants them."""

    def group(prefix: str) -> dict[str, np.ndarray]:
        return {name.removeprefix(prefix): array for name, array in rows.items() if name.startswith(prefix)}

    arguments: dict[str, Any] = {"observations": group("observations/"), "factors": group("factors/")}
    arguments["masks"] = {
        name: np.unpackbits(bits, axis=-1, count=mask_widths[name]).astype(bool)
        for name, bits in group("masks/").items()
    }
    for name in ("actions", "rewards", "terminations", "truncations"):
        if name in rows:
            arguments[name] = rows[name][:-1]
    return arguments
