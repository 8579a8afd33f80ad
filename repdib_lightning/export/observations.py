"""Checks what a caller hands to a frozen encoder, and brings it into the batched form that encoders take."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from torch import Tensor

from repdib_lightning.errors import UserError, nearest
from repdib_lightning.records import ArraySpec, DataSpec

Array = Tensor | np.ndarray[Any, Any]
Observations = Mapping[str, Array] | Array
"""Name -> array, or the bare array where the spec has one observation; (N, *shape) or (*shape)."""


def batched_observations(given: Observations, spec: DataSpec, device: torch.device) -> tuple[dict[str, Tensor], bool]:
    """Check against the spec, move to the device and add the batch axis where it is missing.

    Returns:
        name -> (N, *shape), and whether the batch axis was there already.

    Raises:
        UserError: a name, type or shape that the spec does not have; names the observation and both shapes.
    """
    named = _named(given, spec)
    tensors = {name: _tensor(name, named[name], array) for name, array in spec.observations.items()}
    lengths = {name: _length(name, tensor, spec.observations[name]) for name, tensor in tensors.items()}
    if len(set(lengths.values())) > 1:
        shown = ", ".join(f"'{name}' has {'none' if n is None else n}" for name, n in lengths.items())
        raise UserError(f"observations disagree on the batch: {shown}")
    is_batched = None not in lengths.values()
    moved = {name: tensor.to(device) for name, tensor in tensors.items()}
    return (moved if is_batched else {name: tensor.unsqueeze(0) for name, tensor in moved.items()}), is_batched


def _named(given: Observations, spec: DataSpec) -> Mapping[str, Array]:
    names = list(spec.observations)
    if not isinstance(given, Mapping):
        if len(names) > 1:
            raise UserError(f"one array was given, the encoder takes {len(names)} observations: {', '.join(names)}")
        return {names[0]: given}
    for name in given:
        if name not in spec.observations:
            raise UserError(f"observation '{name}' is unknown to the encoder, {nearest(str(name), names)}")
    for name in names:
        if name not in given:
            raise UserError(f"observation '{name}' is missing (given: {', '.join(map(str, given)) or 'none'})")
    return given


def _tensor(name: str, value: Any, spec: ArraySpec) -> Tensor:
    if isinstance(value, np.ndarray):
        if spec.dtype == "float32" and np.issubdtype(value.dtype, np.floating):
            value = value.astype(np.float32, copy=False)
        if value.dtype not in (np.uint8, np.float32):
            raise _wrong_type(name, str(value.dtype), spec)
        value = torch.from_numpy(np.require(value, requirements=["C", "W"]))
    if not isinstance(value, Tensor):
        raise UserError(f"observation '{name}' must be a numpy array or a tensor, is {type(value).__name__}")
    if spec.dtype == "float32" and value.is_floating_point():
        return value.to(torch.float32)
    if value.dtype != getattr(torch, spec.dtype):
        raise _wrong_type(name, str(value.dtype).removeprefix("torch."), spec)
    return value


def _wrong_type(name: str, given: str, spec: ArraySpec) -> UserError:
    hint = " (0..255, the encoder scales it itself)" if spec.dtype == "uint8" else ""
    return UserError(f"observation '{name}' must be {spec.dtype}{hint}, is {given}")


def _length(name: str, tensor: Tensor, spec: ArraySpec) -> int | None:
    shape = tuple(tensor.shape)
    if shape == spec.shape:
        return None
    if shape[1:] == spec.shape:
        return shape[0]
    hint = _hint(shape, spec)
    raise UserError(f"observation '{name}' has shape {shape}, expected {spec.shape} or (N, *{spec.shape}){hint}")


def _hint(shape: tuple[int, ...], spec: ArraySpec) -> str:
    """What is wrong with a shape that nearly fits."""
    axes, wanted = len(spec.shape), spec.shape
    last = shape[-axes:]
    if len(shape) not in (axes, axes + 1):
        return ""
    if (spec.is_image or spec.is_video) and (*last[:-3], last[-1], *last[-3:-1]) == wanted:
        return "; channels come first"
    if spec.is_sequence and last[::-1] == wanted:
        return "; steps come first, then channels"
    if (spec.is_video or spec.is_sequence) and last[1:] == wanted[1:]:
        missing = "frames of zeros" if spec.is_video else "NaN"
        return f"; a clip has {wanted[0]} steps: cut it, or fill it up with {missing}"
    return ""
