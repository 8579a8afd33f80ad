"""The probe ``groups``: do the groups of a latent hold different factors, and what do they draw?"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from repdib_lightning.bottlenecks.group_edits import GroupLayout, layout_of
from repdib_lightning.bottlenecks.kmeans import kmeans
from repdib_lightning.bottlenecks.nearest import nearest_codes
from repdib_lightning.data.episodes import EpisodeStore
from repdib_lightning.decoders import Decoder
from repdib_lightning.errors import UserError
from repdib_lightning.evaluation.codes import quantile_bins
from repdib_lightning.evaluation.disentanglement import Disentanglement, measure_disentanglement
from repdib_lightning.evaluation.features import encode_rows
from repdib_lightning.evaluation.group_drawing import DrawingReport, measure_drawing
from repdib_lightning.evaluation.redrawing import redraw
from repdib_lightning.evaluation.splits import rows_of
from repdib_lightning.export.frozen import FrozenEncoder
from repdib_lightning.records import Split

FIT_ROWS, SCORE_ROWS = 3000, 2500
CLUSTERS, ROWS_A_CLUSTER = 512, 8
"""An unquantised latent is given codes by k-means, for the measures that need them."""


@dataclass(frozen=True)
class GroupReport:
    """What the groups of one latent hold.

    Attributes:
        positions, groups: P and G.
        codes: ``own``, or how an unquantised latent came by codes, such as ``k-means 375``.
        disentanglement: information is counted on all of these rows; what is learned is fitted on training rows.
        drawing: of the bundle's decoder; None without one.
    """

    positions: int
    groups: int
    codes: str
    disentanglement: Disentanglement
    drawing: DrawingReport | None

    def to_dict(self) -> dict[str, Any]:
        """Plain dictionaries, lists, strings, numbers and None (JSON), with the scores by name."""
        parts = {name: getattr(self, name) for name in ("positions", "groups", "codes")}
        drawing = None if self.drawing is None else self.drawing.to_dict()
        found = self.disentanglement.to_dict()
        return {**parts, "disentanglement": found, "drawing": drawing, "figures": self.figures()}

    def figures(self) -> dict[str, float | None]:
        """The scores by name; groups are told apart by rank, since their numbers mean nothing across seeds."""
        found = self.disentanglement
        scores = {
            "modularity": found.modularity,
            "compactness": found.compactness,
            "explicitness": found.explicitness,
            "mig": found.mig,
            "dci_disentanglement": found.disentanglement,
            "dci_completeness": found.completeness,
            "dci_informativeness": found.informativeness,
            "held": float(len({name for name in found.holds if name is not None})),
        }
        for factor, shares in found.share.items():
            best, rest = _best_and_next(shares)
            scores |= {f"{factor}/share": best, f"{factor}/share_gap": _difference(best, rest)}
            scores[f"{factor}/explicitness"] = found.explicitness_by_factor[factor]
        return scores | ({} if self.drawing is None else self.drawing.figures())


def _best_and_next(values: list[float | None]) -> tuple[float | None, float | None]:
    known = sorted((value for value in values if value is not None), reverse=True)
    return (known[0] if known else None), (known[1] if len(known) > 1 else None)


def _difference(first: float | None, second: float | None) -> float | None:
    return None if first is None or second is None else first - second


def check_grouped(encoder: FrozenEncoder, groups: int | None) -> GroupLayout:
    """The groups of an encoder's latent. Raises UserError where there are none, or others than asked for."""
    return layout_of(encoder.features, encoder.encoder.positions, encoder.groups, groups)


def measure_groups(
    encoder: FrozenEncoder,
    decoder: Decoder | None,
    store: EpisodeStore,
    *,
    groups: int | None = None,
    clusters: int | None = None,
    seed: int = 0,
    progress: bool = True,
) -> GroupReport:
    """Measure how the groups of a latent share out the factors of a store.

    Args:
        encoder: on the device that encodes. decoder: of the same bundle, on the same device, or None.
        store: with factors; at most 3000 training and 2500 held-out rows are read, drawn at random.
        groups: G to cut an unquantised latent into.
        clusters: codes of each part of an unquantised latent; 512 by default, and at most one for 8 training rows and
            positions. How many there are moves every figure: compare latents that have about as many.
        seed: of the choice of rows, the clusters, the shuffles and the forests.
        progress: show progress bars.

    Raises:
        UserError: no groups, or too few training or held-out rows.
    """
    layout = check_grouped(encoder, groups)
    random = np.random.default_rng(seed)
    fit_rows = _some(store, "train", FIT_ROWS, random)
    score_rows = _some(store, "evaluation", SCORE_ROWS, random)
    if len(fit_rows) < 2 or len(score_rows) < 2:
        raise UserError(
            f"{store.path}: groups need at least 2 training and 2 held-out rows, has {len(fit_rows)} and "
            f"{len(score_rows)}; see 'episodes/evaluation'"
        )
    rows = np.concatenate([fit_rows, score_rows])
    latents, codes = encode_rows(encoder, store, rows, device=encoder.device, progress=progress)
    fit = np.arange(len(rows)) < len(fit_rows)
    kind = "own"
    if codes is None:
        codes, kind = _clustered(layout, latents, fit, clusters or CLUSTERS, seed)
    found = measure_disentanglement(
        layout.codes(codes),
        layout.split(latents).transpose(0, 2, 1, 3).reshape(len(rows), layout.groups, -1),
        classes_of(store, rows),
        fit=fit,
        score=~fit,
        seed=seed,
        origins=store.row_recordings[rows],
    )
    drawing = None
    if decoder is not None:
        drawn = redraw(encoder, decoder, store, score_rows, groups)
        drawing = measure_drawing(drawn, store, score_rows, seed, progress)
    return GroupReport(layout.positions, layout.groups, kind, found, drawing)


def classes_of(store: EpisodeStore, rows: np.ndarray) -> dict[str, np.ndarray]:
    """Factor -> (n,) int64 classes; numbers are cut into about ten bins, vectors are taken apart."""
    found: dict[str, np.ndarray] = {}
    for name, spec in store.factors.items():
        values = store.gather(f"factors/{name}", rows).reshape(len(rows), -1)
        if spec.scale == "categorical":
            found[name] = values[:, 0].astype(np.int64)
            continue
        for part in range(values.shape[1]):
            found[name if values.shape[1] == 1 else f"{name}_{part}"] = quantile_bins(values[:, part])
    return found


def _some(store: EpisodeStore, split: Split, count: int, random: np.random.Generator) -> np.ndarray:
    return np.sort(random.permutation(rows_of(store, store.episodes(split)))[:count])


def _clustered(
    layout: GroupLayout, latents: np.ndarray, fit: np.ndarray, wanted: int, seed: int
) -> tuple[np.ndarray, str]:
    """Codes (n, P * G) by k-means on the fit rows, one book a group for all positions."""
    parts = torch.from_numpy(layout.split(latents)).permute(2, 0, 1, 3)  # (G, n, P, D)
    points = parts[:, fit].flatten(1, 2).contiguous()
    clusters = max(2, min(wanted, points.shape[1] // ROWS_A_CLUSTER))
    with torch.random.fork_rng(devices=[]):
        torch.random.default_generator.manual_seed(seed)  # torch.manual_seed would also seed every GPU
        centres, _ = kmeans(points, clusters)
    nearest = nearest_codes(parts.flatten(1, 2).contiguous(), centres)
    codes = nearest.reshape(layout.groups, len(latents), layout.positions).permute(1, 2, 0)
    return codes.reshape(len(latents), -1).numpy(), f"k-means {clusters}"
