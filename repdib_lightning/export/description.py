"""What a bundle says of itself: plain JSON, sealed by a hash of its own content.

::

    format, schema_version       repdib_bundle, 1
    encoder, bottleneck          {class: a name of the allow-list, arguments: plain values}
    decoder                      the same, where the objective drew pictures (absent otherwise)
    classifier                   the same, where the objective recognised a factor (absent otherwise)
    spec                         observations (name -> shape, dtype), actions, frame_stack, horizon, target, classes
    preprocessing                what the caller does to its observations: nothing but stack frames
    features, groups, codes      M, G, L (G = L = 0 where nothing is quantised)
    versions                     of this package and torch, at export
    training, data               facts of the run; the data file's name and fingerprint, what was held out of it
    files                        file name -> SHA-256 of its bytes (absent in a run's own description)
    digest                       SHA-256 of all of the above
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import nn

import repdib_lightning
from repdib_lightning import bottlenecks, classifiers, decoders, encoders
from repdib_lightning.bottlenecks import Bottleneck, PerPosition
from repdib_lightning.encoders.base import Encoder
from repdib_lightning.errors import UserError

FORMAT = "repdib_bundle"
SCHEMA_VERSION = 1
CONFIG, WEIGHTS = "config.json", "model.safetensors"


@dataclass(frozen=True)
class Head:
    """A module of the objective that a bundle may hold beside the encoder.

    Attributes:
        classes: that it may be of, by name.
        registry: name of that list, for messages.
        weights: its file.
        made_by: which objectives have one, for messages.
    """

    classes: Mapping[str, type[nn.Module]]
    registry: str
    weights: str
    made_by: str


HEADS = {
    "decoder": Head(
        decoders.DECODERS, "DECODERS", "model.decoder.safetensors", "an objective that draws pictures (Reconstruction)"
    ),
    "classifier": Head(
        classifiers.CLASSIFIERS,
        "CLASSIFIERS",
        "model.classifier.safetensors",
        "an objective that recognises a factor (Classification)",
    ),
}
"""Key of a description -> what stands there."""

MODEL_DESCRIPTION = "bundle.json"
"""The file of a run folder that says how to rebuild its encoder and bottleneck."""

PREPROCESSING: dict[str, str] = {
    "pictures": "uint8, channels first",
    "sensors": "float32",
    "scaling": "inside the encoder",
    "frame_stack": "along the first axis, oldest first, an episode's first frame repeated",
}
"""One fixed contract: a bundle that states another one is refused, since it would silently encode other inputs."""


def bundle_config(
    encoder: Encoder,
    bottleneck: Bottleneck,
    training: Mapping[str, Any],
    data: Mapping[str, Any],
    heads: Mapping[str, nn.Module] | None = None,
) -> dict[str, Any]:
    """Describe the modules so that they can be rebuilt.

    Args:
        encoder: an instance of a class in ``encoders.ENCODERS``.
        bottleneck: an instance of a class in ``bottlenecks.BOTTLENECKS``.
        training: plain facts of the run, e.g. objective, steps, run.
        data: plain facts of the data, e.g. file, fingerprint. Folders of absolute paths are left out.
        heads: key of :data:`HEADS` -> the module.

    Returns:
        Everything of the module docstring but ``files`` and ``digest``.

    Raises:
        UserError: a class outside the allow-lists, or a value that JSON cannot hold.
    """
    # One bottleneck serves all positions of a grid, of which the encoder tells.
    inner = bottleneck.inner if isinstance(bottleneck, PerPosition) else bottleneck
    more = {key: _described(head, HEADS[key].classes, HEADS[key].registry) for key, head in (heads or {}).items()}
    return {
        "format": FORMAT,
        "schema_version": SCHEMA_VERSION,
        "encoder": _described(encoder, encoders.ENCODERS, "ENCODERS"),
        "bottleneck": _described(inner, bottlenecks.BOTTLENECKS, "BOTTLENECKS"),
        **more,
        "spec": encoder.spec.to_dict(),
        "preprocessing": PREPROCESSING,
        "features": encoder.features,
        "groups": bottleneck.groups,
        "codes": bottleneck.codes,
        "versions": {"repdib_lightning": repdib_lightning.__version__, "torch": str(torch.__version__)},
        "training": _plain(training, "training"),
        "data": _plain(data, "data"),
    }


def sealed(config: Mapping[str, Any]) -> dict[str, Any]:
    """The configuration with the digest of its content."""
    return {**config, "digest": digest(config)}


def digest(config: Mapping[str, Any]) -> str:
    """SHA-256 over everything but the digest itself, however the file is laid out."""
    content = {key: value for key, value in config.items() if key != "digest"}
    canonical = json.dumps(content, sort_keys=True, separators=(",", ":"), allow_nan=False)
    return hashlib.sha256(canonical.encode()).hexdigest()


def as_text(config: Mapping[str, Any]) -> str:
    """The configuration as it stands in its file."""
    return json.dumps(config, indent=2, allow_nan=False) + "\n"


def _described(module: nn.Module, allowed: Mapping[str, type[nn.Module]], where: str) -> dict[str, Any]:
    for name, cls in allowed.items():
        if type(module) is cls:
            return {"class": name, "arguments": _plain(module.arguments, f"{name}.arguments", shorten=False)}
    choices = ", ".join(sorted(allowed))
    raise UserError(f"{type(module).__name__}: cannot be exported, it is not listed in {where} (choices: {choices})")


def _plain(value: Any, key: str, *, shorten: bool = True) -> Any:
    """Copy what JSON can hold; of an absolute path only its last part."""
    if isinstance(value, Mapping):
        return {str(name): _plain(part, f"{key}.{name}", shorten=shorten) for name, part in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(part, f"{key}[{i}]", shorten=shorten) for i, part in enumerate(value)]
    if isinstance(value, Path) or (isinstance(value, str) and Path(value).is_absolute()):
        return Path(value).name if shorten else str(value)
    finite = not isinstance(value, float) or abs(value) < float("inf")
    if finite and (value is None or isinstance(value, (str, int, float))):
        return value
    raise UserError(f"{key}: a bundle holds plain values only (text, finite numbers, lists, maps), got {value!r:.80}")
