"""A bottleneck of its own for each modality."""

from __future__ import annotations

import inspect
from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor, nn

from repdib_lightning.bottlenecks import BOTTLENECKS, Bottleneck
from repdib_lightning.encoders.present_rows import pass_present
from repdib_lightning.errors import UserError, nearest
from repdib_lightning.records import BottleneckOutput


class UnimodalBottlenecks(nn.Module):
    """Passes the vector of each modality through a bottleneck (the paper's RepDIB+Uni); without one, as it is.

    Args:
        name: of the class, or None for none.
        options: its arguments.
        modalities: their names.
        width: of their vectors.

    Raises:
        UserError: a class or argument that does not exist, or what the bottleneck complains of.
    """

    def __init__(self, name: str | None, options: Mapping[str, Any] | None, modalities: list[str], width: int) -> None:
        super().__init__()
        if name is None and options:
            raise UserError("MultimodalEncoder: bottleneck_options are given, but no bottleneck that takes them")
        self.each = nn.ModuleDict()
        if name is not None:
            self.each.update({modality: build_bottleneck(name, options or {}, width) for modality in modalities})

    def forward(self, vectors: dict[str, Tensor], present: dict[str, Tensor]) -> dict[str, BottleneckOutput]:
        """Name -> (N, d) and (N,) bool to name -> what the bottleneck returns: zeros for rows that are missing."""
        if not self.each:
            return {name: BottleneckOutput(rows) for name, rows in vectors.items()}
        return {name: pass_present(self._of(name), rows, present[name]) for name, rows in vectors.items()}

    def require_ready(self) -> None:
        """Raise UserError, naming the modality, unless each is ready."""
        for name in self.each:
            try:
                self._of(name).require_ready()
            except UserError as error:
                raise UserError(f"MultimodalEncoder: bottleneck of '{name}': {error}") from error

    def _of(self, name: str) -> Bottleneck:
        bottleneck = self.each[name]
        assert isinstance(bottleneck, Bottleneck)
        return bottleneck


def mean_values(outputs: list[dict[str, Tensor]]) -> dict[str, Tensor]:
    """Mean of each named scalar over those that have it, as ``unimodal_<name>``."""
    names = dict.fromkeys(name for values in outputs for name in values)
    return {
        f"unimodal_{name}": torch.stack([values[name] for values in outputs if name in values]).mean() for name in names
    }


def build_bottleneck(name: str, options: Mapping[str, Any], width: int) -> Bottleneck:
    """Build the bottleneck of this name.

    Raises:
        UserError: see :class:`UnimodalBottlenecks`.
    """
    if name not in BOTTLENECKS:
        raise UserError(f"MultimodalEncoder: unknown bottleneck '{name}', {nearest(name, BOTTLENECKS)}")
    taken = list(inspect.signature(BOTTLENECKS[name]).parameters)[1:]
    for option in options:
        if option not in taken:
            raise UserError(
                f"MultimodalEncoder: bottleneck_options has '{option}', unknown to {name}, {nearest(option, taken)}"
            )
    try:
        return BOTTLENECKS[name](width, **options)
    except TypeError as error:  # an option of the wrong type
        raise UserError(f"MultimodalEncoder: bottleneck_options do not build a {name} ({error})") from error
