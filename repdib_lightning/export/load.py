"""Loads a bundle: verified bytes, allow-listed classes, no pickle, no Lightning."""

from __future__ import annotations

import hashlib
from pathlib import Path

import torch
from safetensors import SafetensorError
from safetensors.torch import load as read_tensors

from repdib_lightning.errors import UserError
from repdib_lightning.export.description import CONFIG, MODEL_DESCRIPTION, WEIGHTS
from repdib_lightning.export.frozen import FrozenEncoder
from repdib_lightning.export.rebuild import fill, read_description, rebuild


def load_encoder(path: str | Path, device: str | torch.device = "cpu") -> FrozenEncoder:
    """Load the frozen encoder of a bundle.

    Args:
        path: the bundle's folder.
        device: where to put it, e.g. ``cpu`` or ``cuda:0``.

    Raises:
        UserError: no such bundle or device; a run in place of its bundle; a file that is missing, damaged, newer than
            this package, or names classes, arguments or tensors that do not exist here. One line, naming file and key.
    """
    folder = Path(path)
    if not folder.is_dir():
        what = "is a file, a bundle is a folder" if folder.exists() else "no such bundle"
        raise UserError(f"{folder}: {what} with {CONFIG} and {WEIGHTS}")
    _refuse_run(folder)
    config = read_description(folder / CONFIG)
    weights = folder / WEIGHTS
    content = _verified_bytes(weights, config.get("files"), folder / CONFIG)
    frozen = FrozenEncoder(*rebuild(folder / CONFIG, config), config)
    try:
        tensors = read_tensors(content)
    except (SafetensorError, KeyError, ValueError, RuntimeError) as error:
        raise UserError(f"{weights}: not a readable safetensors file ({str(error).splitlines()[0]})") from error
    fill(weights, frozen, tensors, CONFIG)
    try:
        return frozen.to(device)
    except (RuntimeError, AssertionError) as error:
        raise UserError(f"device '{device}' cannot be used ({str(error).splitlines()[0]})") from error


def _refuse_run(folder: Path) -> None:
    is_run = (folder / MODEL_DESCRIPTION).is_file() or (folder / "checkpoints").is_dir()
    if (folder / CONFIG).exists() or not is_run:
        return
    if (folder / "bundle").is_dir():
        raise UserError(f"{folder}: is a run: name its bundle, {folder / 'bundle'}")
    raise UserError(f"{folder}: is a run: export it (python -m repdib_lightning export {folder}), then name its bundle")


def _verified_bytes(path: Path, files: object, described: Path) -> bytes:
    """The file's content, hashed and later parsed from the same bytes, so that nothing can change in between."""
    expected = files.get(WEIGHTS) if isinstance(files, dict) else None
    if expected is None:
        raise UserError(f"{described}: key 'files.{WEIGHTS}' is missing")
    try:
        content = path.read_bytes()
    except FileNotFoundError:
        raise UserError(f"{path}: no such file") from None
    except OSError as error:
        raise UserError(f"{path}: cannot be read ({error.strerror or error})") from error
    if hashlib.sha256(content).hexdigest() != expected:
        raise UserError(f"{path}: content does not match 'files.{WEIGHTS}' of {CONFIG} (damaged or replaced)")
    return content
