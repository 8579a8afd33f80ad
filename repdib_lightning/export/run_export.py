"""From a run folder to a bundle: what a run writes of its model at the start, and the verb ``export RUN``."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, cast

import torch
from torch import Tensor, nn

from repdib_lightning.bottlenecks.base import Bottleneck
from repdib_lightning.classifiers import Classifier
from repdib_lightning.data.files import whole_file
from repdib_lightning.decoders import Decoder
from repdib_lightning.encoders.base import Encoder
from repdib_lightning.errors import UserError
from repdib_lightning.export.bundle import save_bundle
from repdib_lightning.export.description import HEADS, MODEL_DESCRIPTION, as_text, bundle_config, sealed
from repdib_lightning.export.rebuild import fill, read_description, rebuild, rebuild_head
from repdib_lightning.word_lists import words


def write_model_description(
    run_folder: str | Path,
    encoder: Encoder,
    bottleneck: Bottleneck,
    *,
    training: Mapping[str, Any],
    data: Mapping[str, Any],
    heads: Mapping[str, tuple[str, nn.Module]] | None = None,
) -> Path:
    """Write ``bundle.json``, once the modules are built, so that any later checkpoint of the run can be exported.

    Args:
        run_folder: runs/<name>.
        encoder: as built, trained or not.
        bottleneck: as built, trained or not.
        training: plain facts (objective, run); the steps are added at export.
        data: plain facts (file, fingerprint, held_out).
        heads: ``decoder``, ``classifier`` -> its name among the modules of the objective, and the module.

    Returns:
        The file.

    Raises:
        UserError: it cannot be written, or holds what a bundle cannot.
    """
    path = Path(run_folder) / MODEL_DESCRIPTION
    heads = heads or {}
    config = bundle_config(encoder, bottleneck, training, data, {key: head for key, (_, head) in heads.items()})
    for key, (name, _) in heads.items():
        config[key]["module"] = f"objective.{name}"
    text = as_text(sealed(config))
    with whole_file(path) as temporary:
        temporary.write_text(text)
    return path


def export_run(
    run_folder: str | Path,
    output: str | Path | None = None,
    overwrite: bool = False,
    formats: str | Sequence[str] = "safetensors",
) -> Path:
    """Export the newest good checkpoint of a run as a bundle.

    Args:
        run_folder: runs/<name>, as ``fit`` leaves it.
        output: the bundle's folder; ``<run_folder>/bundle`` by default.
        overwrite: replace an existing bundle.
        formats: ``safetensors`` (always written), ``pt2``, ``onnx``; several between commas.

    Returns:
        The bundle's folder.

    Raises:
        UserError: no such run, no checkpoint or none that is undamaged, weights that do not fit the description, or as
            :func:`~repdib_lightning.export.bundle.save_bundle`.
    """
    run = Path(run_folder)
    if not run.is_dir():
        raise UserError(f"{run}: no such run folder")
    path = run / MODEL_DESCRIPTION
    if not path.is_file():
        raise UserError(f"{run}: holds no {MODEL_DESCRIPTION}, so it is no run folder or its fit never began")
    config = read_description(path)
    encoder, bottleneck = rebuild(path, config)
    checkpoint_file = _newest_checkpoint(run)
    checkpoint = torch.load(checkpoint_file, map_location="cpu", weights_only=True)
    heads = {key: rebuild_head(path, key, config, encoder).eval() for key in HEADS if key in config}
    modules = nn.ModuleDict({"encoder": encoder, "bottleneck": bottleneck})
    fill(checkpoint_file, modules, _parts(checkpoint, modules), path.name)
    for key, head in heads.items():
        fill(checkpoint_file, head, _parts(checkpoint, head, f"{config[key].get('module')}."), path.name)
    training = {"run": run.resolve().name, **config["training"], "steps": int(checkpoint["global_step"])}
    folder = run / "bundle" if output is None else Path(output)
    return save_bundle(
        folder,
        encoder.eval(),
        bottleneck.eval(),
        training=training,
        data=config["data"],
        decoder=cast(Decoder | None, heads.get("decoder")),
        classifier=cast(Classifier | None, heads.get("classifier")),
        overwrite=overwrite,
        formats=words(formats, "formats"),
    )


def _newest_checkpoint(run: Path) -> Path:
    # Only here: load_encoder shares this package and must not wait for what training imports.
    from repdib_lightning.callbacks.checkpoint_files import FOLDER, last_good, listed

    # Asked first, since what last_good says of an empty folder is advice for resuming.
    if not listed(run / FOLDER if (run / FOLDER).is_dir() else run):
        raise UserError(f"{run}: has no checkpoint yet: nothing to export")
    try:
        return last_good(run)
    except UserError as error:
        raise UserError(f"{run}: all its checkpoints are damaged: nothing to export") from error


def _parts(checkpoint: Mapping[str, Any], module: nn.Module, prefix: str = "") -> dict[str, Tensor]:
    """The weights of a module under its prefix (none: encoder and bottleneck); all else stays behind.

    A run in bf16-true or 64-true leaves weights of that precision; they become the modules' own, float32.
    """
    expected, prefixes = module.state_dict(), (prefix,) if prefix else ("encoder.", "bottleneck.")
    saved = checkpoint["state_dict"].items()
    parts = {name.removeprefix(prefix): value for name, value in saved if name.startswith(prefixes)}
    for name, value in parts.items():
        if name in expected and value.is_floating_point() and expected[name].is_floating_point():
            parts[name] = value.to(expected[name].dtype)
    return parts
