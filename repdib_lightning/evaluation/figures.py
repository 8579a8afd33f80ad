"""Figures of probe reports as PNG bytes; each title says what to look for."""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from PIL import Image

from repdib_lightning.data.episodes import EpisodeStore
from repdib_lightning.evaluation.tables import KINDS

if TYPE_CHECKING:
    from repdib_lightning.evaluation.decoder import Drawings
    from repdib_lightning.evaluation.probe_report import ProbeReport

COLOURS = ("#0072B2", "#E69F00", "#009E73", "#CC79A7", "#56B4E9", "#D55E00")
"""Okabe and Ito's palette, told apart by readers with any colour vision."""

_HARDLY_SEEN = 0.5
"""Mean change of a pixel's colours, of 255."""

SHOULD = {"endogenous": "State kept (high is good)", "exogenous": "Noise kept (low is good)"}


def png(figure: Figure, dpi: int = 110) -> bytes:
    """Draw a figure, small and opaque; the same figure gives the same bytes."""
    drawn = io.BytesIO()
    figure.savefig(drawn, format="png", dpi=dpi)
    return small_png(Image.open(drawn))


def small_png(picture: Image.Image) -> bytes:
    """A PNG file of a picture, in 256 colours where no pixel but a few changes by much."""
    whole = picture.convert("RGB")
    few = whole.quantize(256, method=Image.Quantize.MEDIANCUT, dither=Image.Dither.NONE)
    changed = np.abs(np.asarray(few.convert("RGB"), np.int16) - np.asarray(whole, np.int16)).mean()
    content = io.BytesIO()
    (few if changed <= _HARDLY_SEEN else whole).save(content, "PNG", optimize=True)
    return content.getvalue()


def panel_grid(count: int, columns: int, width: float, height: float) -> tuple[Figure, list[Axes]]:
    """A figure of ``count`` panels of this size in inches, at most ``columns`` side by side."""
    columns = min(columns, count)
    lines = -(-count // columns)
    figure = Figure(figsize=(width * columns, height * lines + 0.5), layout="constrained")
    panels = figure.subplots(lines, columns, squeeze=False).ravel().tolist()
    for panel in panels[count:]:
        panel.set_visible(False)
    return figure, panels[:count]


def kept_bars(reports: Mapping[str, ProbeReport]) -> bytes:
    """Bars of *kept* for each factor, the runs side by side, state apart from noise.

    Bars are the first probe (linear); a diamond marks the second (MLP) where there is one.
    """
    first = next(iter(reports.values()))
    kinds = {k: [n for n, f in first.factors.items() if f.kind == k] for k in KINDS}
    shown = {kind: names for kind, names in kinds.items() if names}
    widths = [max(len(names), 1.5) for names in shown.values()]
    figure = Figure(figsize=(max(6.5, 1.25 * sum(widths) + 1.8), 4.2), layout="constrained")
    axes = figure.subplots(1, len(shown), sharey=True, width_ratios=widths, squeeze=False)[0]
    for axis, (kind, names) in zip(axes, shown.items(), strict=True):
        _draw_kept(axis, reports, names)
        axis.set_title(SHOULD[kind], loc="left", fontsize=11)
    axes[0].set_ylabel("kept: 0 = chance, 1 = all")
    axes[0].set_ylim(0, 1.12)
    handles, labels = axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=len(first.probes), frameon=False)
    return png(figure)


def _draw_kept(axis: Axes, reports: Mapping[str, ProbeReport], names: Sequence[str]) -> None:
    width = 0.8 / len(reports)
    for i, (run, report) in enumerate(reports.items()):
        bars, *others = report.probes
        places = np.arange(len(names)) + (i - (len(reports) - 1) / 2) * width
        heights = [report.factors[name].probes[bars].kept for name in names]
        colour = COLOURS[i % len(COLOURS)]
        axis.bar(places, [h or 0.0 for h in heights], width * 0.92, color=colour, label=f"{run} ({bars})")
        second = [[report.factors[name].probes[other].kept for name in names] for other in others[:1]]
        for kept in second:
            known = [(x, k) for x, k in zip(places, kept, strict=True) if k is not None]
            axis.plot(
                *zip(*known, strict=True) if known else ([], []),
                "D", color=colour, markeredgecolor="black", markersize=6, label=f"{run} ({others[0]})", clip_on=False,
            )  # fmt: skip
        for column, (x, height) in enumerate(zip(places, heights, strict=True)):
            top = max([height or 0.0, *[kept[column] or 0.0 for kept in second]])
            text = "n/a" if height is None else f"{height:.2f}"
            axis.text(x, top + 0.03, text, ha="center", va="bottom", fontsize=8)
    axis.set_xticks(range(len(names)), [_wrapped(name) for name in names], fontsize=9)
    axis.set_xlim(-0.6, len(names) - 0.4)
    plain_axes(axis)


def bits_map(reports: Mapping[str, ProbeReport]) -> bytes | None:
    """Heat map of bits, groups by factors, one panel a run with codes; None if no run has any."""
    coded = {run: report for run, report in reports.items() if report.codebook is not None}
    if not coded:
        return None
    factors = next(iter(coded.values())).factors
    tallest = max(report.groups for report in coded.values())
    size = (1.5 + len(coded) * max(3.5, 0.85 * len(factors) + 1.2), 2.2 + 0.3 * tallest)
    figure = Figure(figsize=size, layout="constrained")
    axes = figure.subplots(1, len(coded), squeeze=False)[0]
    bits = {run: np.array([f.bits.bits if f.bits else [] for f in r.factors.values()]).T for run, r in coded.items()}
    highest = max(1e-9, *[float(b.max()) for b in bits.values()])
    for axis, (run, report) in zip(axes, coded.items(), strict=True):
        picture = axis.imshow(bits[run], cmap="cividis", vmin=0, vmax=highest, aspect="auto")
        _annotate(axis, bits[run], highest)
        labels = [f"{_wrapped(n)}\n(of {f.bits.entropy:.1f})" for n, f in report.factors.items() if f.bits]
        axis.set_xticks(range(len(labels)), labels, fontsize=8)
        axis.set_yticks(range(report.groups), [str(g) for g in range(report.groups)], fontsize=8)
        axis.axvline(sum(f.kind == "endogenous" for f in factors.values()) - 0.5, color="white", linewidth=3)
        axis.set_ylabel("group")
        axis.set_title(f"{run}: bits of each group about state (left) and noise (right)", fontsize=10, loc="left")
    figure.colorbar(picture, ax=axes[-1], label="bits")
    return png(figure)


def _annotate(axis: Axes, values: np.ndarray, highest: float) -> None:
    """Numbers in the cells, while there are few enough to read."""
    if values.shape[0] > 16:
        return
    for (row, column), value in np.ndenumerate(values):
        colour = "black" if value > 0.55 * highest else "white"
        axis.text(column, row, f"{value:.2f}", ha="center", va="center", fontsize=7, color=colour)


def codebook_bars(reports: Mapping[str, ProbeReport]) -> bytes | None:
    """Codes in use and perplexity of each group; None if no run has codes."""
    coded = {run: report.codebook for run, report in reports.items() if report.codebook is not None}
    if not coded:
        return None
    figure = Figure(figsize=(8, 0.6 + 2.4 * len(coded)), layout="constrained")
    axes = figure.subplots(len(coded), 1, squeeze=False)[:, 0]
    for axis, (run, use) in zip(axes, coded.items(), strict=True):
        places = np.arange(len(use.used))
        axis.bar(places - 0.2, use.used, 0.4, color=COLOURS[4], label="codes in use")
        axis.bar(places + 0.2, use.perplexity, 0.4, color=COLOURS[0], label="perplexity (even use = codes in use)")
        axis.axhline(use.codes_per_group, color="black", linestyle="--", linewidth=1, label="codes there are")
        axis.set_xticks(places)
        axis.set_ylim(0, use.codes_per_group * 1.1)
        axis.set_title(
            f"{run}: few codes in use means a codebook too large, or a collapsed one", fontsize=10, loc="left"
        )
        axis.set_xlabel("group")
        plain_axes(axis)
    handles, labels = axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=3, frameon=False)
    return png(figure)


def frame_strip(store: EpisodeStore, rows: np.ndarray, names: Sequence[str], count: int = 8) -> bytes | None:
    """Evenly spaced frames of (n,) rows, one line a view; None if none of the observations is a picture."""
    views = [name for name in names if store.observations[name].is_image]
    if not views:
        return None
    chosen = rows[np.linspace(0, len(rows) - 1, min(count, len(rows))).astype(int)]
    figure = Figure(figsize=(1.35 * len(chosen) + 0.3, 1.45 * len(views) + 0.6), layout="constrained")
    axes = figure.subplots(len(views), len(chosen), squeeze=False)
    for line, view in zip(axes, views, strict=True):
        for axis, picture in zip(line, store.gather(f"observations/{view}", chosen), strict=True):
            _draw_picture(axis, picture)
        line[0].set_ylabel(view)
    for axis, row in zip(axes[-1], chosen, strict=True):
        axis.set_xlabel(f"row {row}", fontsize=8)
    figure.suptitle("Evaluation frames, evenly spaced over the recording: what the encoder sees", fontsize=10)
    return png(figure)


def drawn_strip(drawings: Mapping[str, Drawings]) -> bytes:
    """Held-out frames, and below each what the decoder drew of it from the latent of every run; a block a view."""
    first = next(iter(drawings.values()))
    views, columns = list(first.frames), len(first.rows)
    lines = len(views) * (1 + len(drawings))
    figure = Figure(figsize=(1.2 * columns + 0.8, 1.25 * lines + 0.5), layout="constrained")
    axes = figure.subplots(lines, columns, squeeze=False)
    place = iter(axes)
    for view in views:
        _draw_line(next(place), first.frames[view], f"{view}\nframe")
        for run, drawing in drawings.items():
            _draw_line(next(place), drawing.drawn[view], f"{view}\n{run}")
    figure.suptitle("Held-out frames, and what each latent still tells of them", fontsize=11)
    return png(figure)


def _draw_line(axes: Sequence[Axes], pictures: np.ndarray, label: str) -> None:
    for axis, picture in zip(axes, pictures, strict=True):
        _draw_picture(axis, picture)
    axes[0].set_ylabel(label, fontsize=9)


def _draw_picture(axis: Axes, picture: np.ndarray) -> None:
    """(C, H, W) uint8; of a stack of frames the first one."""
    channels = 3 if len(picture) >= 3 else 1
    shown = picture[:channels].transpose(1, 2, 0)
    axis.imshow(shown if channels == 3 else shown[..., 0], cmap="gray", vmin=0, vmax=255)
    axis.set_xticks([])
    axis.set_yticks([])


def principal_plane(latents: np.ndarray) -> np.ndarray:
    """Project (n, M) on its first two principal components: (n, 2), signs fixed so that repeats agree."""
    import torch

    centred = torch.from_numpy(np.asarray(latents, np.float64))
    centred = centred - centred.mean(0)
    vectors = torch.linalg.eigh(centred.T @ centred)[1].flip(1)[:, :2]
    signs = torch.sign(vectors.gather(0, vectors.abs().argmax(0, keepdim=True)))
    plane = (centred @ (vectors * signs)).numpy()
    return np.pad(plane, ((0, 0), (0, 2 - plane.shape[1])))


def latent_scatter(latents: Mapping[str, np.ndarray], colourings: Mapping[str, tuple[np.ndarray, str]]) -> bytes:
    """PCA of each run's latents (lines), coloured by each factor (columns).

    Args:
        latents: run -> (n, M).
        colourings: factor -> ((n,) values, kind); integer values are classes and get their number written at the
            middle of their points, others a colour scale.
    """
    size = (4.3 * len(colourings) + 0.4, 3.5 * len(latents) + 0.3)
    figure = Figure(figsize=size, layout="constrained")
    axes = figure.subplots(len(latents), len(colourings), squeeze=False)
    hints = {"endogenous": "state: colours should separate", "exogenous": "noise: colours should mix"}
    for line, (run, points) in zip(axes, latents.items(), strict=True):
        plane = principal_plane(points)
        for axis, (factor, (values, kind)) in zip(line, colourings.items(), strict=True):
            classes = np.issubdtype(values.dtype, np.integer)
            dots = axis.scatter(*plane.T, c=values, cmap="turbo" if classes else "viridis", s=6, linewidths=0)
            if classes:
                number_classes(axis, plane, values)
            else:
                figure.colorbar(dots, ax=axis, shrink=0.8)
            axis.set_title(f"{run}, by {factor}\n({hints[kind]})", fontsize=9)
            axis.set_xticks([])
            axis.set_yticks([])
    return png(figure)


def number_classes(axis: Axes, plane: np.ndarray, values: np.ndarray) -> None:
    """Numbers make classes readable without telling colours apart."""
    classes = np.unique(values)
    if len(classes) > 40:
        return
    box: dict[str, Any] = {"boxstyle": "round,pad=0.15", "facecolor": "white", "edgecolor": "none", "alpha": 0.8}
    for label in classes:
        x, y = np.median(plane[values == label], axis=0)
        axis.text(x, y, str(label), fontsize=8, ha="center", va="center", bbox=box)


def _wrapped(name: str) -> str:
    return name.replace("_", "\n")


def plain_axes(axis: Axes) -> None:
    """Leave out the frame's upper and right edge; faint horizontal lines."""
    axis.spines[["top", "right"]].set_visible(False)
    axis.grid(axis="y", alpha=0.25)
    axis.set_axisbelow(True)


def slant_names(axis: Axes) -> None:
    """Long names below an axis: slanted, each ending at its tick, so that none covers its neighbour."""
    for name in axis.get_xticklabels():
        name.set(rotation=35, ha="right", rotation_mode="anchor")
