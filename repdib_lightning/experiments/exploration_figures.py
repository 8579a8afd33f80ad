"""Figures of what came of fine-tuning from several snapshots of an exploration, as PNG bytes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import matplotlib
import numpy as np
from matplotlib.colors import to_hex
from matplotlib.figure import Figure

from repdib_lightning.errors import UserError
from repdib_lightning.evaluation.embedding import tsne
from repdib_lightning.evaluation.figures import panel_grid, plain_axes, png
from repdib_lightning.experiments.curves import Band
from repdib_lightning.experiments.figures import draw_band, legend_below

MOST_DOTS = 1000
"""In a panel of latents."""

_FEWEST_DOTS, _DPI = 3, 80
_SCRATCH = "#777777"
_LIGHTEST, _DARKEST = 0.35, 1.0


@dataclass(frozen=True)
class Valued:
    """Latents that an agent met, and what its critic takes them to be worth.

    Attributes:
        latents: (n, M). values: (n,).
    """

    latents: np.ndarray
    values: np.ndarray

    def thinned(self, count: int) -> Valued:
        """``count`` rows at even distances."""
        rows = np.linspace(0, len(self.values) - 1, count).astype(int)
        return Valued(self.latents[rows], self.values[rows])


def read_valued(path: Path) -> Valued:
    """Read a fine-tuning's ``values.npz``.

    Raises:
        UserError: it is damaged, or holds other arrays.
    """
    try:
        with np.load(path, allow_pickle=False) as file:
            found = Valued(np.asarray(file["latents"], np.float32), np.asarray(file["values"], np.float64))
        if found.latents.ndim != 2 or found.values.shape != found.latents.shape[:1] or not len(found.values):
            raise ValueError(f"latents {found.latents.shape}, values {found.values.shape}")
        if not (np.isfinite(found.latents).all() and np.isfinite(found.values).all()):
            raise ValueError("not all of them are finite")
    except Exception as error:  # a damaged file makes zip, zlib and numpy raise a dozen unrelated kinds
        reason = (str(error) or type(error).__name__).splitlines()[0]
        raise UserError(f"{path}: not the values of a fine-tuning ({reason}); fine-tune again") from error
    return found


def snapshot_curves(
    panels: Mapping[str, Mapping[int, Band]], scratch: Mapping[str, Band], *, task: str, column: str
) -> bytes | None:
    """A panel a setting, a line a snapshot, the darker the later; None without any.

    Args:
        panels: setting -> frames of the snapshot -> band of ``column``.
        scratch: setting without pre-training -> band, in grey in every panel.
        task: name of the fine-tuning. column: of its progress.
    """
    shown = {setting: bands for setting, bands in panels.items() if bands}
    if not shown:
        return None
    figure, axes = panel_grid(len(shown), 4, 3.3, 2.9)
    colours = _sequential(sorted({frames for bands in shown.values() for frames in bands}))
    highest, lowest = _limits([*(band for bands in shown.values() for band in bands.values()), *scratch.values()])
    for panel, (setting, bands) in zip(axes, shown.items(), strict=True):
        for name, band in scratch.items():
            draw_band(panel, band, f"{name} (no pre-training)", _SCRATCH, "--")
        for frames, band in sorted(bands.items()):
            draw_band(panel, band, f"after {frames:,} frames of exploration", colours[frames])
        panel.set_title(f"{setting} (n={max(band.seeds for band in bands.values())})", fontsize=10)
        panel.set_xlabel("frames of fine-tuning", fontsize=9)
        panel.set_ylim(lowest, highest)
        plain_axes(panel)
    figure.suptitle(f"{task}: {column}", fontsize=11)
    legend_below(figure, axes)
    return png(figure, dpi=_DPI)


def _sequential(frames: Sequence[int]) -> dict[int, str]:
    shades = np.linspace(_LIGHTEST, _DARKEST, len(frames)) if len(frames) > 1 else [_DARKEST]
    return {count: to_hex(matplotlib.colormaps["YlGnBu"](shade)) for count, shade in zip(frames, shades, strict=True)}


def _limits(bands: Sequence[Band]) -> tuple[float, float]:
    """Highest and lowest number of all panels, with a margin."""
    high, low = (
        max(float(band.high.max()) for band in bands if len(band.high)),
        min(float(band.low.min()) for band in bands if len(band.low)),
    )
    margin = 0.04 * (high - low) or 1.0
    return high + margin, low - margin


def value_maps(valued: Mapping[str, Valued], *, task: str) -> bytes | None:
    """t-SNE of each setting's latents side by side, as many of each, on one scale of values; None for too few.

    Args:
        valued: setting -> its latents and values. task: name of the fine-tuning.
    """
    count = min([MOST_DOTS, *(len(part.values) for part in valued.values())])
    if not valued or count < _FEWEST_DOTS:
        return None
    shown = {setting: part.thinned(count) for setting, part in valued.items()}
    low, high = value_range(shown)
    figure = Figure(figsize=(3.2 * len(shown) + 0.8, 3.5), layout="constrained")
    axes = figure.subplots(1, len(shown), squeeze=False)[0]
    for panel, (setting, part) in zip(axes, shown.items(), strict=True):
        order = np.argsort(part.values, kind="stable")  # the high ones on top
        plane = tsne(part.latents)[order]
        dots = panel.scatter(*plane.T, c=part.values[order], cmap="viridis", vmin=low, vmax=high, s=7, linewidths=0)
        panel.set_title(setting, fontsize=10)
        panel.set_xticks([])
        panel.set_yticks([])
    figure.colorbar(dots, ax=axes[-1], shrink=0.85, label="value")
    figure.suptitle(f"{task}: latents by the critic's value, {low:.3g} (purple) to {high:.3g} (yellow)", fontsize=11)
    return png(figure, dpi=_DPI)


def value_range(valued: Mapping[str, Valued]) -> tuple[float, float]:
    """Lowest and highest value of all settings."""
    values = np.concatenate([part.values for part in valued.values()])
    return float(values.min()), float(values.max())
