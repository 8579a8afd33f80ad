"""Writes a bundle: a folder that appears only when it is complete and could be read back."""

from __future__ import annotations

import hashlib
import os
import shutil
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import torch
from safetensors.torch import save as tensors_to_bytes
from torch import Tensor, nn

from repdib_lightning.bottlenecks.base import Bottleneck
from repdib_lightning.bottlenecks.vector_quantiser import VectorQuantiser
from repdib_lightning.classifiers import Classifier
from repdib_lightning.data.files import sync_directory, sync_file
from repdib_lightning.decoders import Decoder
from repdib_lightning.encoders.base import Encoder
from repdib_lightning.errors import UserError
from repdib_lightning.export.description import CONFIG, HEADS, WEIGHTS, as_text, bundle_config, sealed
from repdib_lightning.export.formats import check_formats, write_format
from repdib_lightning.export.load import load_classifier, load_decoder, load_encoder
from repdib_lightning.word_lists import words


def save_bundle(
    folder: str | Path,
    encoder: Encoder,
    bottleneck: Bottleneck,
    *,
    training: Mapping[str, Any],
    data: Mapping[str, Any],
    decoder: Decoder | None = None,
    classifier: Classifier | None = None,
    overwrite: bool = False,
    formats: str | Sequence[str] = "safetensors",
) -> Path:
    """Write ``config.json``, ``model.safetensors`` and the optional formats; read back before it is published.

    Args:
        folder: the bundle to make.
        encoder: trained; its class must be in ``encoders.ENCODERS``.
        bottleneck: trained; its class must be in ``bottlenecks.BOTTLENECKS``.
        training: plain facts of the run (objective, steps, run).
        data: plain facts of the data (file, fingerprint, held_out); folders of absolute paths are left out.
        decoder: trained, of the latents of both; its class must be in ``decoders.DECODERS``.
        classifier: the same; its class must be in ``classifiers.CLASSIFIERS``.
        overwrite: replace an existing bundle (never a folder that holds anything else).
        formats: ``safetensors`` (always written), ``pt2`` (torch.export), ``onnx``; several between commas.

    Returns:
        The folder.

    Raises:
        UserError: the folder exists or cannot be written, a quantiser that never started, weights that are not finite,
            a class or value that a bundle cannot hold, an unknown format, or a package that a format needs.
    """
    target = Path(folder)
    _check_target(target, overwrite)
    chosen = words(formats, "formats")
    check_formats(chosen)
    modules: dict[str, nn.Module] = {"encoder": encoder, "bottleneck": bottleneck}
    heads: dict[str, nn.Module] = {}
    if decoder is not None:
        heads["decoder"] = decoder
    if classifier is not None:
        heads["classifier"] = classifier
    encoder.require_ready()
    _check_trained([*modules.values(), *heads.values()])
    config = bundle_config(encoder, bottleneck, training, data, heads)
    content = tensors_to_bytes(_weights(nn.ModuleDict(modules)))
    with whole_folder(target) as aside:
        for key, head in heads.items():
            (aside / HEADS[key].weights).write_bytes(tensors_to_bytes(_weights(head)))
        beside = [HEADS[key].weights for key in heads]
        _write(aside, content, config, beside)
        frozen = load_encoder(aside)
        for key in heads:
            {"decoder": load_decoder, "classifier": load_classifier}[key](aside)
        written = [name for form in chosen for name in write_format(form, frozen, aside)]
        _write(aside, content, config, [*beside, *written])
    return target


def _write(aside: Path, content: bytes, config: Mapping[str, Any], more: Sequence[str]) -> None:
    (aside / WEIGHTS).write_bytes(content)
    files = {WEIGHTS: hashlib.sha256(content).hexdigest(), **{name: _sha256(aside / name) for name in more}}
    (aside / CONFIG).write_text(as_text(sealed({**config, "files": files})))


def _weights(module: nn.Module) -> dict[str, Tensor]:
    # Cloned, since safetensors refuses tensors that share memory.
    return {name: value.detach().cpu().contiguous().clone() for name, value in module.state_dict().items()}


def _check_trained(parts: Sequence[nn.Module]) -> None:
    for module in (module for part in parts for module in part.modules()):
        if isinstance(module, VectorQuantiser):
            module.require_ready()
    for part in parts:
        for name, parameter in part.named_parameters():
            if not bool(torch.isfinite(parameter).all()):
                raise UserError(f"{type(part).__name__}: parameter '{name}' is not finite (NaN or infinite)")


def _check_target(target: Path, overwrite: bool) -> None:
    if not target.exists() and not target.is_symlink():
        return
    if not overwrite:
        raise UserError(f"{target}: exists already; choose another folder or pass --overwrite")
    is_bundle = target.is_dir() and not target.is_symlink() and (target / CONFIG).is_file()
    is_empty = target.is_dir() and not any(target.iterdir())
    if not is_bundle and not is_empty:
        raise UserError(f"{target}: is no bundle, so --overwrite does not replace it; choose another folder")
    ours = {CONFIG, "probe.json"}  # a probe of the bundle that is replaced says nothing about the new one
    foreign = sorted(p.name for p in target.iterdir() if p.name not in ours and not p.name.startswith("model."))
    if foreign:
        raise UserError(f"{target}: holds '{foreign[0]}', which --overwrite would delete; choose another folder")


@contextmanager
def whole_folder(target: Path) -> Iterator[Path]:
    """Yield a temporary sibling folder; on success it takes the target's place, on error it vanishes."""
    aside = target.with_name(f".{target.name}.tmp-{os.getpid()}")
    previous = target.with_name(f".{target.name}.old-{os.getpid()}")
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        shutil.rmtree(aside, ignore_errors=True)
        aside.mkdir()
        yield aside
        for file in aside.iterdir():
            sync_file(file)
        sync_directory(aside)
        if target.exists():
            os.rename(target, previous)
        os.rename(aside, target)
        sync_directory(target.parent)
    except OSError as error:
        if previous.exists() and not target.exists():
            os.rename(previous, target)
        raise UserError(f"{target}: cannot be written ({error.strerror or error})") from error
    finally:
        shutil.rmtree(aside, ignore_errors=True)
        shutil.rmtree(previous, ignore_errors=True)


def _sha256(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()
