"""Optional forms of the model beside the safetensors file, for programs without this package."""

from __future__ import annotations

import importlib.util
from collections.abc import Sequence
from pathlib import Path

import torch
from torch import Tensor, nn

from repdib_lightning.errors import UserError, nearest
from repdib_lightning.export.frozen import FrozenEncoder
from repdib_lightning.records import DataSpec

LARGEST_DIFFERENCE = 1e-5
"""How far the latents of an exported form may be from the module's own."""

_NEEDED_PACKAGES = {"safetensors": (), "pt2": (), "onnx": ("onnx", "onnxscript")}
_MAX_BATCH = 4096
_CHECKED_BATCH = 33


class Exportable(nn.Module):
    """The pure tensor part of a frozen encoder: name -> (N, *shape) to (latent, codes), or to latent alone.

    Args:
        frozen: the encoder whose modules are used.
    """

    def __init__(self, frozen: FrozenEncoder) -> None:
        super().__init__()
        self.encoder = frozen.encoder
        self.bottleneck = frozen.bottleneck
        self.eval()

    def forward(self, observations: dict[str, Tensor]) -> tuple[Tensor, ...]:
        """Encode a batch into ((N, M),), or ((N, M), (N, G)) where the bottleneck quantises."""
        output = self.bottleneck(self.encoder(observations))
        # Copies, since tracing compares a view's shape with its base's, and so forbids batches that look like G.
        return tuple(part.clone() for part in (output.latent, output.codes) if part is not None)


def check_formats(formats: Sequence[str]) -> None:
    """Check that the formats exist and can be written here.

    Raises:
        UserError: an unknown format, or one whose packages are not installed.
    """
    for name in formats:
        if name not in _NEEDED_PACKAGES:
            raise UserError(f"unknown export format '{name}', {nearest(name, _NEEDED_PACKAGES)}")
        missing = [package for package in _NEEDED_PACKAGES[name] if importlib.util.find_spec(package) is None]
        if missing:
            raise UserError(f"format '{name}' needs {' and '.join(missing)}: pip install {' '.join(missing)}")


def write_format(name: str, frozen: FrozenEncoder, folder: Path) -> list[str]:
    """Write one optional form into the folder; ``safetensors`` is always there and writes nothing.

    Returns:
        Names of the files written.
    """
    if name == "pt2":
        return _write_program(frozen, folder)
    if name == "onnx":
        return _write_onnx(frozen, folder)
    return []


def example_batch(spec: DataSpec, size: int, seed: int = 0) -> dict[str, Tensor]:
    """Random observations of a spec, name -> (size, *shape), the same for the same seed."""
    generator = torch.Generator().manual_seed(seed)
    batch = {}
    for name, array in spec.observations.items():
        shape = (size, *array.shape)
        if array.dtype == "uint8":
            batch[name] = torch.randint(0, 256, shape, generator=generator, dtype=torch.uint8)
        else:
            batch[name] = torch.randn(shape, generator=generator)
    return batch


def _traced(frozen: FrozenEncoder) -> torch.export.ExportedProgram:
    batch = torch.export.Dim("batch", min=1, max=_MAX_BATCH)
    shapes = {"observations": {name: {0: batch} for name in frozen.spec.observations}}
    example = example_batch(frozen.spec, 2)
    with torch.no_grad():
        program = torch.export.export(Exportable(frozen), (example,), dynamic_shapes=shapes)
    # Lowered, since a program that still holds autocast regions can be saved but not loaded (torch 2.15).
    lowered: torch.export.ExportedProgram = program.run_decompositions({})
    assert lowered.range_constraints, "the batch axis stayed free"
    return lowered


def _write_program(frozen: FrozenEncoder, folder: Path) -> list[str]:
    torch.export.save(_traced(frozen), folder / "model.pt2")
    _check_same(Exportable(frozen), torch.export.load(folder / "model.pt2").module(), frozen.spec)
    return ["model.pt2"]


def _write_onnx(frozen: FrozenEncoder, folder: Path) -> list[str]:
    outputs = ["latent", "codes"] if frozen.groups else ["latent"]
    torch.onnx.export(
        _traced(frozen),
        f=folder / "model.onnx",
        input_names=list(frozen.spec.observations),
        output_names=outputs,
        dynamo=True,
        external_data=False,
        verbose=False,
    )
    return ["model.onnx"]


def _check_same(module: nn.Module, other: nn.Module, spec: DataSpec) -> None:
    """Compare on a batch that was not traced."""
    batch = example_batch(spec, _CHECKED_BATCH, seed=1)
    with torch.no_grad():
        expected, given = module(batch), other(batch)
    assert torch.allclose(expected[0], given[0], rtol=0, atol=LARGEST_DIFFERENCE), "exported latents differ"
    assert len(expected) == len(given), "an output is missing from the exported program"
    assert all(torch.equal(e, g) for e, g in zip(expected[1:], given[1:], strict=True)), "exported codes differ"
