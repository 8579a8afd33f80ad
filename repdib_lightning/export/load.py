"""Loads a bundle: verified bytes, allow-listed classes, no pickle, no Lightning."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any, TypeVar, cast

import torch
from safetensors import SafetensorError
from safetensors.torch import load as read_tensors
from torch import nn

from repdib_lightning.classifiers import Classifier
from repdib_lightning.decoders import Decoder
from repdib_lightning.errors import UserError
from repdib_lightning.export.description import CONFIG, HEADS, MODEL_DESCRIPTION, WEIGHTS
from repdib_lightning.export.frozen import FrozenEncoder
from repdib_lightning.export.rebuild import fill, read_description, rebuild, rebuild_head

Module = TypeVar("Module", bound=nn.Module)


def load_encoder(path: str | Path, device: str | torch.device = "cpu") -> FrozenEncoder:
    """Load the frozen encoder of a bundle.

    Args:
        path: the bundle's folder.
        device: where to put it, e.g. ``cpu`` or ``cuda:0``.

    Raises:
        UserError: no such bundle or device; a run in place of its bundle; a file that is missing, damaged, newer than
            this package, or names classes, arguments or tensors that do not exist here. One line, naming file and key.
    """
    config = _description_of(Path(path))
    frozen = FrozenEncoder(*rebuild(Path(path) / CONFIG, config), config)
    return _filled(frozen, Path(path), WEIGHTS, config, device)


def load_decoder(path: str | Path, device: str | torch.device = "cpu") -> Decoder:
    """Load the decoder of a bundle whose objective drew pictures, frozen, in evaluation mode.

    Args:
        path: the bundle's folder.
        device: where to put it.

    Raises:
        UserError: as :func:`load_encoder`; or a bundle without a decoder.
    """
    return cast(Decoder, _load_head("decoder", Path(path), device))


def load_classifier(path: str | Path, device: str | torch.device = "cpu") -> Classifier:
    """Load the classifier of a bundle whose objective recognised a factor, frozen, in evaluation mode.

    It takes the latents (N, M) that the bundle's encoder gives; ``target`` names the factor, ``classes`` its values.

    Args:
        path: the bundle's folder.
        device: where to put it.

    Raises:
        UserError: as :func:`load_encoder`; or a bundle without a classifier.
    """
    return cast(Classifier, _load_head("classifier", Path(path), device))


def _load_head(key: str, folder: Path, device: str | torch.device) -> nn.Module:
    config = _description_of(folder)
    encoder, _ = rebuild(folder / CONFIG, config)
    head = rebuild_head(folder / CONFIG, key, config, encoder).requires_grad_(False).eval()
    return _filled(head, folder, HEADS[key].weights, config, device)


def _description_of(folder: Path) -> dict[str, Any]:
    if not folder.is_dir():
        what = "is a file, a bundle is a folder" if folder.exists() else "no such bundle"
        raise UserError(f"{folder}: {what} with {CONFIG} and {WEIGHTS}")
    _refuse_run(folder)
    return read_description(folder / CONFIG)


def _filled(module: Module, folder: Path, name: str, config: Mapping[str, Any], device: str | torch.device) -> Module:
    """The module with the weights of one file, on a device."""
    weights = folder / name
    content = _verified_bytes(weights, config.get("files"), folder / CONFIG)
    try:
        tensors = read_tensors(content)
    except (SafetensorError, KeyError, ValueError, RuntimeError) as error:
        raise UserError(f"{weights}: not a readable safetensors file ({str(error).splitlines()[0]})") from error
    fill(weights, module, tensors, CONFIG)
    try:
        return module.to(device)
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
    expected = files.get(path.name) if isinstance(files, dict) else None
    if expected is None:
        raise UserError(f"{described}: key 'files.{path.name}' is missing")
    try:
        content = path.read_bytes()
    except FileNotFoundError:
        raise UserError(f"{path}: no such file") from None
    except OSError as error:
        raise UserError(f"{path}: cannot be read ({error.strerror or error})") from error
    if hashlib.sha256(content).hexdigest() != expected:
        raise UserError(f"{path}: content does not match 'files.{path.name}' of {CONFIG} (damaged or replaced)")
    return content
