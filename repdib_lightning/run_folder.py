"""One folder a run: the whole configuration, versions and the data's fingerprint, beside its logs and checkpoints."""

from __future__ import annotations

import json
import shutil
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from lightning.pytorch.utilities.rank_zero import rank_zero_only

from repdib_lightning.data.files import whole_file
from repdib_lightning.errors import UserError, nearest
from repdib_lightning.versions import versions

CONFIGURATION = "config.yaml"


@rank_zero_only
def open_run(folder: Path, configuration: str, data: Mapping[str, Any], *, resumed: bool) -> None:
    """Make the run's folder (or go on in it) and write config.yaml and environment.json.

    ``data`` tells its file and fingerprint. Called when the options, the data and the model are known to be good, just
    before training.

    Raises:
        UserError: a new run's folder exists, or the folder cannot be written.
    """
    make_folder(folder, exist_ok=resumed)
    with whole_file(folder / CONFIGURATION) as path:
        path.write_text(configuration)
    if not resumed:
        facts = {"versions": versions(), "data": {name: data[name] for name in ("file", "fingerprint")}}
        with whole_file(folder / "environment.json") as path:
            path.write_text(json.dumps(facts, indent=1) + "\n")


@rank_zero_only
def remove_stillborn(folder: Path) -> None:
    """Remove a run that ended before its first checkpoint: it cannot go on, and would only block its name."""
    if (folder / CONFIGURATION).is_file() and not list(folder.glob("checkpoints/*.ckpt")):
        shutil.rmtree(folder)
        if folder.parent == Path("runs") and not any(folder.parent.iterdir()):
            folder.parent.rmdir()


def default_folder(configurations: list[str]) -> Path:
    """runs/<names of the configurations>-<date>-<time>."""
    names = [Path(name).stem for name in configurations] or ["robot_arm"]
    return Path("runs") / f"{'-'.join(names)}-{time.strftime('%Y%m%d-%H%M%S')}"


def make_folder(folder: Path, *, exist_ok: bool) -> None:
    """Create a run's folder. Raises UserError if it exists already (unless that is wanted) or cannot be made."""
    check_new(folder, exist_ok=exist_ok)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        probe = folder / ".write-test"
        probe.touch()
        probe.unlink()
    except OSError as error:
        raise UserError(f"{folder}: cannot be written ({error.strerror or error})") from error


@rank_zero_only
def check_new(folder: Path, *, exist_ok: bool = False) -> None:
    """Raise UserError if a new run's folder exists and is not empty."""
    if folder.exists() and not folder.is_dir():
        raise UserError(f"{folder}: is a file, a run needs a folder; choose another --run")
    if not exist_ok and folder.is_dir() and any(folder.iterdir()):
        raise UserError(f"{folder}: exists already; choose another --run, or go on with --resume {folder}")


def existing(folder: Path) -> Path:
    """Return the folder of a run that can go on. Raises UserError with the nearest run otherwise."""
    if not (folder / CONFIGURATION).is_file():
        runs = [str(path.parent) for path in folder.parent.glob(f"*/{CONFIGURATION}")] if folder.parent.is_dir() else []
        raise UserError(
            f"{folder}: no such run ({CONFIGURATION} is missing); {nearest(str(folder), runs) or 'there is none'}"
        )
    return folder
