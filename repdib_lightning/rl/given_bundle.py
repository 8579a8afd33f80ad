"""The bundle that a user names."""

from __future__ import annotations

from pathlib import Path

from repdib_lightning.errors import UserError
from repdib_lightning.export.description import CONFIG


def checked_bundle(path: Path | None) -> Path | None:
    """A bundle's folder; of a run's folder, the bundle in it.

    Raises:
        UserError: neither, with the command that exports one.
    """
    if path is None:
        return None
    inside = path / "bundle"
    found = inside if inside.is_dir() else path
    if not (found / CONFIG).is_file():
        what = "holds no bundle" if path.is_dir() else "is a file, a bundle is a folder" if path.exists() else ""
        run = path if (path / "checkpoints").is_dir() else "RUN"
        raise UserError(
            f"--encoder {path}: {what or 'no such bundle'}; export one: python -m repdib_lightning export {run}"
        )
    return found
