"""The decoder probe: how much of the picture can be drawn again from the frozen latent, background and agent apart.

The paper reconstructs the robot's image from the frozen representation ("visual noise") and names neither decoder nor
error. Here the decoder is kernel ridge regression from the latent to all pixels, fitted on one half of the held-out
episodes and scored on the other. It is solved in closed form, so that no budget of training steps decides what counts
as kept.

The error of a region is the squared error of its pixels over that of the best picture that ignores the latent: of the
mean picture for the agent's pixels, and of the mean background (each pixel's mean over the frames where the agent does
not cover it) for all others. ``kept`` is 1 - error, between 0 and 1.

A latent that does not tell where the agent stands draws a faint trace of it into the background, which counts as error
there: on the robot arm, whose arm covers 3 % of the pixels, at most 0.01.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from repdib_lightning.data.episodes import EpisodeStore
from repdib_lightning.errors import UserError
from repdib_lightning.evaluation.kernel_ridge import KernelRidge, fit_kernel_ridge
from repdib_lightning.evaluation.splits import episode_folds

MOST_ROWS = 2500
SHOWN = 8
_CHUNK = 256


@dataclass(frozen=True)
class RegionScore:
    """How well the pixels of one region are drawn, over all views.

    Attributes:
        error: squared error relative to a picture that ignores the latent. kept: 1 - error, between 0 and 1.
        rmse: root of the mean squared error in grey levels of 255.
    """

    error: float
    kept: float
    rmse: float


@dataclass(frozen=True)
class PictureReport:
    """What the latent kept of the pictures.

    Attributes:
        regions: ``background`` and ``agent`` (where the store has masks of the agent), and ``picture`` (all pixels).
        fit_rows: rows that the decoder was fitted on.
        choice: kernel width (0: linear) and penalty, chosen by held-out episodes of the fit half.
    """

    regions: dict[str, RegionScore]
    fit_rows: int
    choice: dict[str, float]


@dataclass(frozen=True)
class Drawings:
    """Some frames of the score half beside what was drawn of them: view -> (n, C, H, W) uint8; rows (n,)."""

    rows: np.ndarray
    frames: dict[str, np.ndarray]
    drawn: dict[str, np.ndarray]


def check_pictures(store: EpisodeStore) -> list[str]:
    """Names of the observations that can be drawn. Raises UserError if there is none."""
    views = [name for name, spec in store.observations.items() if spec.is_image]
    if not views:
        raise UserError(f"{store.path}: has no pictures to draw again; leave 'decoder' out of probes")
    return views


def measure_pictures(
    features: np.ndarray, store: EpisodeStore, rows: np.ndarray, in_fit: np.ndarray
) -> tuple[PictureReport, Drawings]:
    """Fit the decoder on the rows of the fit half and score it on all others.

    Args:
        features: (n, M) latents of ``rows``, standardised on the fit half.
        store: holds the pictures, and ``masks/<view>`` where the agent's pixels are known.
        rows: (n,) of the store. in_fit: (n,) bool.
    """
    views = check_pictures(store)
    inside = np.flatnonzero(in_fit)
    inside = inside[np.unique(np.linspace(0, len(inside) - 1, min(MOST_ROWS, len(inside))).astype(int))]
    outside = np.flatnonzero(~in_fit)
    targets = {view: _flat(store, view, rows[inside]) for view in views}
    # Summed in float64, the mean of pixels that never vary is exact: rounding must not pass for variance.
    means = {view: target.mean(0, dtype=np.float64).astype(np.float32) for view, target in targets.items()}
    gram = sum(_gram(targets[view] - means[view]) for view in views)
    folds = episode_folds(store.row_recordings[rows[inside]])
    decoder = fit_kernel_ridge(features[inside], gram, folds)  # type: ignore[arg-type]
    shown = outside[np.linspace(0, len(outside) - 1, min(SHOWN, len(outside))).astype(int)]
    sums: dict[str, np.ndarray] = {}
    frames, drawn = {}, {}
    for view in views:
        target, mean = targets.pop(view), means[view]
        masked = view in store.masks
        backdrop = _mean_background(target, store.mask(view, rows[inside]), mean) if masked else mean
        target -= mean
        for first in range(0, len(outside), _CHUNK):
            part = outside[first : first + _CHUNK]
            drawing = _draw(decoder, features[part], target, mean)
            truth = _flat(store, view, rows[part])
            agent = _covered(store.mask(view, rows[part]), truth.shape[1]) if masked else None
            _add(sums, drawing, truth, mean, backdrop, agent)
        shape = store.observations[view].shape
        frames[view] = store.gather(f"observations/{view}", rows[shown])
        pixels = np.clip(_draw(decoder, features[shown], target, mean) * 255.0, 0, 255)
        drawn[view] = pixels.round().astype(np.uint8).reshape(-1, *shape)
    regions = {name: _score(*values) for name, values in sums.items()}
    choice = {"width": decoder.kernel.width or 0.0, "penalty": decoder.penalty}
    return PictureReport(regions, len(inside), choice), Drawings(rows[shown], frames, drawn)


def _flat(store: EpisodeStore, view: str, rows: np.ndarray) -> np.ndarray:
    """(n, C*H*W) float32 in [0, 1]."""
    return store.gather(f"observations/{view}", rows).reshape(len(rows), -1).astype(np.float32) / 255.0


def _gram(centred: np.ndarray) -> np.ndarray:
    return (centred @ centred.T).astype(np.float64)


def _draw(decoder: KernelRidge, features: np.ndarray, centred: np.ndarray, mean: np.ndarray) -> np.ndarray:
    return decoder.weights(features).astype(np.float32) @ centred + mean


def _covered(mask: np.ndarray, width: int) -> np.ndarray:
    """(n, H, W) bool of the agent to (n, C*H*W)."""
    flat = mask.reshape(len(mask), -1)
    return np.tile(flat, (1, width // flat.shape[1]))


def _mean_background(target: np.ndarray, mask: np.ndarray, mean: np.ndarray) -> np.ndarray:
    """Each pixel's mean over the frames where the agent does not cover it; its plain mean if it always does."""
    free = ~_covered(mask, target.shape[1])
    counts = free.sum(0)
    total = np.sum(target * free, 0, dtype=np.float64)
    return np.where(counts > 0, total / np.maximum(counts, 1), mean).astype(np.float32)


def _add(
    sums: dict[str, np.ndarray],
    drawing: np.ndarray,
    truth: np.ndarray,
    mean: np.ndarray,
    backdrop: np.ndarray,
    agent: np.ndarray | None,
) -> None:
    """Add a part's squared errors, those without the latent, and the number of pixels, region by region."""
    error, plain = np.square(drawing - truth), np.square(mean - truth)
    parts = {"picture": (error.sum(), plain.sum(), error.size)}
    if agent is not None:
        ground = ~agent
        parts["background"] = (error[ground].sum(), np.square(backdrop - truth)[ground].sum(), ground.sum())
        parts["agent"] = (error[agent].sum(), plain[agent].sum(), agent.sum())
    for name, values in parts.items():
        sums[name] = sums.get(name, np.zeros(3)) + np.array(values, np.float64)


def _score(error: float, plain: float, pixels: float) -> RegionScore:
    """A region that never varies (or has no pixels) is drawn perfectly by its mean: error 1, nothing kept."""
    relative = error / plain if plain > 0 else 1.0
    rmse = 255.0 * float(np.sqrt(error / pixels)) if pixels else 0.0
    return RegionScore(float(relative), float(np.clip(1.0 - relative, 0.0, 1.0)), rmse)
