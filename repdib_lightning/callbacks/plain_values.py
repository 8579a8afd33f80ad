"""Only tensors and primitives: what a checkpoint may hold, so that it can be read without unpickling code."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Mapping
from enum import Enum
from pathlib import Path
from typing import Any

import numpy as np
import torch

from repdib_lightning.errors import UserError

_KEPT = (type(None), bool, int, float, str, bytes, torch.Size, torch.dtype, torch.device)


def plain(value: Any, key: str = "checkpoint") -> Any:
    """Return the value as nested containers of tensors and primitives; numpy, paths and enums are converted.

    Args:
        value: nested dictionaries, lists, tuples, sets of anything; tensors are passed on, not copied.
        key: where the value stands, for the error.

    Raises:
        UserError: something else is in it; names its key.
    """
    if type(value) in _KEPT or isinstance(value, torch.Tensor):
        return value
    if isinstance(value, np.ndarray) and value.dtype.kind in "biuf":
        return torch.from_numpy(value.copy())
    if isinstance(value, np.generic):
        return plain(value.item(), key)
    if isinstance(value, Enum):
        return plain(value.value, key)
    if isinstance(value, Path):
        return str(value)
    for kind in (int, float, str):
        if isinstance(value, kind):
            return kind(value)
    if isinstance(value, Mapping):
        return _plain_mapping(value, key)
    if isinstance(value, (list, tuple, set)):
        items = [plain(item, f"{key}.{number}") for number, item in enumerate(value)]
        return next(kind for kind in (list, tuple, set) if isinstance(value, kind))(items)
    name = f"{type(value).__module__}.{type(value).__qualname__}"
    raise UserError(f"{key} holds a {name}: checkpoints hold tensors and plain values only")


def _plain_mapping(value: Mapping[Any, Any], key: str) -> dict[Any, Any]:
    items = {plain(name, f"{key} (a key)"): plain(item, f"{key}.{name}") for name, item in value.items()}
    if not isinstance(value, OrderedDict):
        return items
    ordered = OrderedDict(items)
    if hasattr(value, "_metadata"):  # torch keeps the versions of a state dict's layers here
        ordered._metadata = plain(value._metadata, f"{key}._metadata")  # type: ignore[attr-defined]
    return ordered
