"""Reads a description back with suspicion, and builds the modules it names. Nothing in it can import anything."""

from __future__ import annotations

import inspect
import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NoReturn, TypeVar

import torch
from torch import Tensor, nn

from repdib_lightning import bottlenecks, encoders
from repdib_lightning.bottlenecks import Bottleneck, for_positions
from repdib_lightning.encoders.base import Encoder
from repdib_lightning.errors import UserError, nearest
from repdib_lightning.export.description import FORMAT, HEADS, PREPROCESSING, SCHEMA_VERSION, digest
from repdib_lightning.records import ActionSpec, ArraySpec, DataSpec

_KINDS: dict[str, type] = {
    "encoder": dict,
    "bottleneck": dict,
    "spec": dict,
    "preprocessing": dict,
    "features": int,
    "groups": int,
    "codes": int,
    "versions": dict,
    "training": dict,
    "data": dict,
}
_NAMES = {dict: "a map", int: "a whole number", str: "text", list: "a list"}

Part = TypeVar("Part", bound=nn.Module)


def read_description(path: Path) -> dict[str, Any]:
    """Read and check a bundle's ``config.json`` or a run's ``bundle.json``.

    Raises:
        UserError: missing, unreadable, not JSON, not a bundle's, newer than this package, damaged, or incomplete.
    """
    try:
        config = json.loads(path.read_bytes().decode(), parse_constant=_refuse_constant)
    except FileNotFoundError:
        raise UserError(f"{path}: no such file") from None
    except OSError as error:
        raise UserError(f"{path}: cannot be read ({error.strerror or error})") from error
    except (ValueError, RecursionError) as error:
        raise UserError(f"{path}: not valid JSON ({_first_line(error)})") from error
    if not isinstance(config, dict) or config.get("format") != FORMAT:
        raise UserError(f"{path}: not a bundle of this package ('format' must be '{FORMAT}')")
    version = _value(path, config, "schema_version", int)
    if version > SCHEMA_VERSION:
        raise UserError(
            f"{path}: 'schema_version' {version} is newer than this package reads ({SCHEMA_VERSION}); "
            "upgrade repdib_lightning"
        )
    if version < 1:
        raise UserError(f"{path}: 'schema_version' must be at least 1, is {version}")
    if _value(path, config, "digest", str) != digest(config):
        raise UserError(f"{path}: content does not match its 'digest' (damaged, or edited by hand); export it again")
    for key, kind in _KINDS.items():
        _value(path, config, key, kind)
    if config["preprocessing"] != PREPROCESSING:
        raise UserError(f"{path}: 'preprocessing' is not what this package does; upgrade repdib_lightning")
    return config


def rebuild(path: Path, config: Mapping[str, Any]) -> tuple[Encoder, Bottleneck]:
    """Build the two modules of a description (untrained), leaving torch's random state as it was.

    Raises:
        UserError: a spec that is none, a class outside the allow-lists, arguments the class does not take, or widths
            that disagree with what was built. Names the file and the key.
    """
    spec = _spec(path, config["spec"])
    with torch.random.fork_rng(devices=[]):
        encoder = _build(path, "encoder", config, encoders.ENCODERS, spec)
        bottleneck = for_positions(
            lambda width: _build(path, "bottleneck", config, bottlenecks.BOTTLENECKS, width),
            encoder.features,
            encoder.positions,
        )
    built = {"features": encoder.features, "groups": bottleneck.groups, "codes": bottleneck.codes}
    for key, size in built.items():
        if config[key] != size:
            raise UserError(f"{path}: '{key}' is {config[key]}, the modules it describes have {size}")
    return encoder, bottleneck


def rebuild_head(path: Path, key: str, config: Mapping[str, Any], encoder: Encoder) -> nn.Module:
    """Build a head of a description (untrained), leaving torch's random state as it was.

    Args:
        path: of the description, for the message.
        key: of :data:`HEADS`.
        config: the description.
        encoder: as :func:`rebuild` gave it.

    Raises:
        UserError: as :func:`rebuild`; or a description without this head.
    """
    if key not in config:
        raise UserError(f"{path}: has no {key}; only {HEADS[key].made_by} exports one")
    _value(path, config, key, dict)
    with torch.random.fork_rng(devices=[]):
        return _build(path, key, config, HEADS[key].classes, encoder.spec, encoder.features)


def fill(path: Path, module: nn.Module, tensors: Mapping[str, Tensor], described: str) -> None:
    """Load weights strictly: every tensor, no other, of the same shape and type.

    Args:
        path: the file the tensors come from, for the message.
        module: gets them.
        tensors: name -> value.
        described: the file that describes the module, for the message.

    Raises:
        UserError: names the file and the first tensor that is missing, left over or of another shape or type.
    """
    expected = module.state_dict()
    for name in expected:
        if name not in tensors:
            raise UserError(f"{path}: tensor '{name}', which {described} asks for, is missing")
    for name, value in tensors.items():
        if name not in expected:
            raise UserError(f"{path}: tensor '{name}' has no place in what {described} describes")
        if value.dtype != expected[name].dtype:
            raise UserError(f"{path}: tensor '{name}' is {value.dtype}, {described} asks for {expected[name].dtype}")
    try:
        module.load_state_dict(dict(tensors))
    except (RuntimeError, ValueError) as error:
        why = _misfit(module, tensors, described) or f"does not fit {described}: {_first_line(error)}"
        raise UserError(f"{path}: {why}") from error


def _misfit(module: nn.Module, tensors: Mapping[str, Tensor], described: str) -> str:
    """The first tensor of another shape; asked after loading, since a module may resize itself while it loads."""
    for name, wanted in module.state_dict().items():
        given = tuple(tensors[name].shape)
        if given != tuple(wanted.shape):
            return f"tensor '{name}' has shape {given}, {described} asks for {tuple(wanted.shape)}"
    return ""


def _build(path: Path, key: str, config: Mapping[str, Any], allowed: Mapping[str, type[Part]], *first: Any) -> Part:
    name = _value(path, config[key], "class", str, f"{key}.")
    arguments = _value(path, config[key], "arguments", dict, f"{key}.")
    if name not in allowed:
        raise UserError(f"{path}: '{key}.class' is unknown: '{name}', {nearest(name, allowed)}")
    taken = list(inspect.signature(allowed[name]).parameters)[len(first) :]
    for argument in arguments:
        if argument not in taken:
            raise UserError(
                f"{path}: '{key}.arguments' has '{argument}', unknown to {name}; {nearest(argument, taken)}"
            )
    try:
        return allowed[name](*first, **arguments)
    # Values of a wrong type fail in ways that only the class knows; all of them are the file's fault.
    except Exception as error:
        raise UserError(f"{path}: '{key}.arguments' do not build a {name}: {_first_line(error)}") from error


def _spec(path: Path, plain: Mapping[str, Any]) -> DataSpec:
    observations = {}
    for name, array in _value(path, plain, "observations", dict, "spec.").items():
        key = f"spec.observations.{name}"
        if not isinstance(array, dict) or not {"shape", "dtype"} <= set(array) <= {"shape", "dtype", "mean", "std"}:
            raise UserError(f"{path}: '{key}' must hold 'shape' and 'dtype' (and may hold 'mean' and 'std')")
        shape, dtype = array["shape"], array["dtype"]
        if not isinstance(shape, list) or not shape or not all(_is_count(size) for size in shape):
            raise UserError(f"{path}: '{key}.shape' must be a list of sizes, is {shape!r:.60}")
        if dtype not in ("uint8", "float32"):
            raise UserError(f"{path}: '{key}.dtype' must be uint8 or float32, is {dtype!r:.60}")
        for measured in sorted({"mean", "std"} & set(array)):
            if not _are_numbers(array[measured], shape[-1]):
                raise UserError(f"{path}: '{key}.{measured}' must be a list of {shape[-1]} finite numbers")
        observations[name] = ArraySpec.from_dict(array)
    if not observations:
        raise UserError(f"{path}: 'spec.observations' is empty")
    for count, least in (("frame_stack", 1), ("horizon", 0)):
        if _value(path, plain, count, int, "spec.") < least:
            raise UserError(f"{path}: 'spec.{count}' must be at least {least}, is {plain[count]!r:.60}")
    actions = plain.get("actions")
    if actions is not None:
        described = isinstance(actions, dict) and set(actions) == {"kind", "size"} and _is_count(actions["size"])
        if not described or actions["kind"] not in ("discrete", "continuous"):
            raise UserError(
                f"{path}: 'spec.actions' must hold kind (discrete or continuous) and size, is {actions!r:.60}"
            )
    next_frame = plain.get("next_frame", False)  # bundles written before there was one lack it
    if not isinstance(next_frame, bool):
        raise UserError(f"{path}: 'spec.next_frame' must be true or false, is {next_frame!r:.60}")
    target, classes = plain.get("target", ""), plain.get("classes", [])  # as next_frame
    if not isinstance(target, str) or not isinstance(classes, list) or not all(isinstance(c, str) for c in classes):
        raise UserError(f"{path}: 'spec.target' must be text, and 'spec.classes' a list of names")
    return DataSpec(
        observations,
        None if actions is None else ActionSpec(**actions),
        plain["frame_stack"],
        plain["horizon"],
        next_frame,
        target,
        tuple(classes),
    )


def _value(path: Path, plain: Mapping[str, Any], key: str, kind: type, prefix: str = "") -> Any:
    if key not in plain:
        raise UserError(f"{path}: key '{prefix}{key}' is missing")
    value = plain[key]
    if not isinstance(value, kind) or isinstance(value, bool):
        raise UserError(f"{path}: '{prefix}{key}' must be {_NAMES[kind]}, is {value!r:.60}")
    return value


def _are_numbers(values: Any, count: int) -> bool:
    """Whether this is a list of so many finite numbers."""
    plain = isinstance(values, list) and all(isinstance(v, (int, float)) and not isinstance(v, bool) for v in values)
    return plain and len(values) == count and all(math.isfinite(value) for value in values)


def _is_count(value: Any) -> bool:
    return isinstance(value, int) and not isinstance(value, bool) and value >= 1


def _refuse_constant(word: str) -> NoReturn:
    raise ValueError(f"'{word}' is no JSON")


def _first_line(error: BaseException) -> str:
    return (str(error).splitlines() or [type(error).__name__])[0]
