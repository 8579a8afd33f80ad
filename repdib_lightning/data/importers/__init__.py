"""One file for each foreign format; each importer is a function that streams it into a store."""

from __future__ import annotations

from collections.abc import Callable
from importlib import import_module
from pathlib import Path

from repdib_lightning.errors import UserError, nearest

IMPORTERS: dict[str, str] = {
    "vd4rl": "repdib_lightning.data.importers.vd4rl:import_vd4rl",
    "images": "repdib_lightning.data.importers.image_folder:import_images",
    "store": "repdib_lightning.data.importers.repack:import_store",
}


def find_importer(name: str) -> Callable[..., Path]:
    """Import and return the function of a format: ``(source, output, *, overwrite, progress, ...) -> output``.

    Raises:
        UserError: no such format.
    """
    if name not in IMPORTERS:
        raise UserError(f"import: unknown format '{name}' {nearest(name, IMPORTERS)}")
    module, _, function = IMPORTERS[name].partition(":")
    return getattr(import_module(module), function)
