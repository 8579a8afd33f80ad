"""Makes the folder of a run of ``finetune``."""

from __future__ import annotations

import shutil
from pathlib import Path

from repdib_lightning.errors import UserError
from repdib_lightning.rl.options import CONFIGURATION


def check_folder(folder: Path, overwrite: bool) -> None:
    """Raise UserError where a folder exists already, unless ``finetune`` made it and it is to be replaced."""
    if not folder.exists() or (folder.is_dir() and not any(folder.iterdir())):
        return
    if not overwrite:
        raise UserError(f"--run {folder}: exists already; choose another folder or pass --overwrite")
    if not (folder / CONFIGURATION).is_file():
        raise UserError(f"--run {folder}: is no run of finetune, so --overwrite does not replace it")


def make_folder(folder: Path) -> None:
    """Make the folder, empty. Raises UserError where that cannot be."""
    try:
        if folder.is_dir():
            shutil.rmtree(folder)
        folder.mkdir(parents=True)
    except OSError as error:
        raise UserError(f"--run {folder}: cannot be made ({error.strerror or error})") from error
