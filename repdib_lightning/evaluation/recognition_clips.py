"""Clips as a picture: frames and readings, what was recognised, and where attention went."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from repdib_lightning.data.episodes import EpisodeStore
from repdib_lightning.data.frame_captions import rate_of
from repdib_lightning.evaluation.figures import COLOURS, png
from repdib_lightning.evaluation.recognition_pass import Recognised

_FRAMES, _TOLD, _CHANNELS = 6, 3, 12
"""Frames of a view, classes that are named, and channels up to which a sequence is drawn as lines."""
_LABEL, _MAIN, _WEIGHT, _GUESSES, _GAP = 1.05, 4.2, 0.75, 1.75, 0.12
_HEAD, _FOOT, _TRACE, _STRIP, _SPACE = 0.36, 0.42, 0.52, 0.09, 0.07
"""Inches: of the columns of a block, of what is above and below it, and of the parts of a modality's line."""
_FRAME = _MAIN / _FRAMES
_TITLE = 0.62
_RIGHT, _WRONG, _SHADE = COLOURS[2], COLOURS[5], "Oranges"


@dataclass(frozen=True)
class ShownClip:
    """One clip as it is drawn.

    Attributes:
        row: of the store. label: the true class, as the classifier numbers them.
        probabilities: (classes,).
        observations: modality -> (T, ...), as stored.
        over_time: modality -> (steps,) attention, where there is any. weights: modality -> its share.
    """

    row: int
    label: int
    probabilities: np.ndarray
    observations: dict[str, np.ndarray]
    over_time: dict[str, np.ndarray]
    weights: dict[str, float]

    @property
    def right(self) -> bool:
        """Whether the most probable class is the true one."""
        return int(self.probabilities.argmax()) == self.label

    @property
    def end(self) -> float:
        """Share of the stored steps after which nothing was observed of any modality; 1 where nothing was at all."""
        ends = [(1 + there[-1]) / len(a) for a in self.observations.values() if len(there := np.flatnonzero(seen(a)))]
        return max(ends, default=1.0)


def seen(array: np.ndarray) -> np.ndarray:
    """(T,) bool: steps of a video (T, C, H, W) or sequence (T, X) that were observed."""
    return np.asarray(array.any((1, 2, 3)) if array.ndim == 4 else np.isfinite(array).any(1))


def shown_clip(store: EpisodeStore, recognised: Recognised, labels: np.ndarray, index: int) -> ShownClip:
    """Collect what is drawn of one of the clips that were recognised."""
    row = recognised.rows[[index]]
    names = sorted(recognised.modalities, key=lambda name: not store.observations[name].is_video)
    shares = recognised.attention.get("modalities")
    return ShownClip(
        row=int(row[0]),
        label=int(labels[index]),
        probabilities=recognised.probabilities[index],
        observations={name: store.gather(f"observations/{name}", row)[0] for name in names},
        over_time={name: recognised.attention[name][index] for name in names if name in recognised.attention},
        weights={} if shares is None else dict(zip(recognised.modalities, map(float, shares[index]), strict=True)),
    )


def clip_figure(store: EpisodeStore, clips: Sequence[ShownClip], classes: Sequence[str], title: str) -> bytes:
    """Draw clips in blocks, two side by side: a line a modality, its weight, and the three most probable classes.

    Args:
        store: names the channels and their rates. classes: of the classifier. title: says what was chosen, and how.
    """
    columns = min(2, len(clips))
    lines = -(-len(clips) // columns)
    wide = _LABEL + _MAIN + _WEIGHT + _GUESSES + 4 * _GAP
    tall = _HEAD + sum(_height(array) for array in clips[0].observations.values()) + _FOOT
    size = (wide * columns + 0.1, _TITLE + tall * lines)
    figure = Figure(figsize=size)
    figure.text(0.12 / size[0], 1 - 0.1 / size[1], title, fontsize=12, va="top")
    told = "Orange below a line: attention over its time. Bars beside it: weight of the modality."
    figure.text(0.12 / size[0], 1 - 0.36 / size[1], told, fontsize=9.5, va="top", color="0.35")
    for place, clip in enumerate(clips):
        corner = (place % columns * wide, _TITLE + place // columns * tall)
        _Block(figure, size, corner, store, classes).draw(clip)
    return png(figure)


def _height(array: np.ndarray) -> float:
    return (_FRAME if array.ndim == 4 else _TRACE) + _STRIP + _SPACE


@dataclass(frozen=True)
class _Block:
    """Where one clip is drawn; places are inches from the block's upper left corner."""

    figure: Figure
    size: tuple[float, float]
    corner: tuple[float, float]
    store: EpisodeStore
    classes: Sequence[str]

    def axis(self, left: float, top: float, width: float, height: float) -> Axes:
        across, down = self.size
        x, y = self.corner[0] + left, self.corner[1] + top
        return self.figure.add_axes((x / across, 1 - (y + height) / down, width / across, height / down))

    def text(self, left: float, top: float, words: str, **options: object) -> None:
        x, y = (self.corner[0] + left) / self.size[0], 1 - (self.corner[1] + top) / self.size[1]
        self.figure.text(x, y, words, va="top", **options)  # type: ignore[arg-type]

    def draw(self, clip: ShownClip) -> None:
        truth, told = self.classes[clip.label], self.classes[int(clip.probabilities.argmax())]
        outcome, colour = ("recognised", _RIGHT) if clip.right else (f"mistaken for {told}", _WRONG)
        self.text(_LABEL, 0.1, f"{truth}: {outcome}", fontsize=11, weight="bold", color=colour)
        self.text(_LABEL + _MAIN, 0.12, f"row {clip.row}", fontsize=8.5, color="0.45", ha="right")
        top, end = _HEAD, clip.end
        for name, array in clip.observations.items():
            high = _height(array) - _STRIP - _SPACE
            main = self.axis(_LABEL, top, _MAIN, high)
            _draw_observed(main, array, end)
            main.set_ylabel(_broken(name), fontsize=9, rotation=0, ha="right", va="center", labelpad=6)
            strip = self.axis(_LABEL, top + high, _MAIN, _STRIP)
            _draw_attention(strip, clip.over_time.get(name), end)
            if clip.weights:
                self._draw_weight(clip.weights[name], max(clip.weights.values()), top, high)
            top += high + _STRIP + _SPACE
        _mark_time(strip, self._seconds(clip), end)
        self._draw_guesses(clip)

    def _draw_weight(self, weight: float, most: float, top: float, high: float) -> None:
        axis = self.axis(_LABEL + _MAIN + _GAP, top, _WEIGHT, high)
        axis.barh(0, weight, 0.35, color=COLOURS[1])
        axis.text(weight + 0.03 * most, 0, f"{weight:.2f}", va="center", fontsize=8)
        axis.set_xlim(0, max(1e-6, 1.75 * most))
        axis.set_ylim(-0.6, 0.6)
        _bare(axis)

    def _draw_guesses(self, clip: ShownClip) -> None:
        best = np.argsort(-clip.probabilities, kind="stable")[:_TOLD]
        axis = self.axis(_LABEL + _MAIN + _WEIGHT + 2 * _GAP, _HEAD, _GUESSES, 0.36 * len(best))
        for place, index in enumerate(best):
            chance = float(clip.probabilities[index])
            colour = _RIGHT if index == clip.label else _WRONG if place == 0 else "0.75"
            axis.barh(place + 0.2, chance, 0.22, color=colour)
            axis.text(0, place - 0.13, self.classes[index], fontsize=8.5, va="center")
            axis.text(1, place - 0.13, f"{chance:.2f}", fontsize=8.5, va="center", ha="right")
        axis.set_xlim(0, 1)
        axis.set_ylim(len(best) - 0.55, -0.4)
        _bare(axis)
        if clip.label not in best:
            chance = float(clip.probabilities[clip.label])
            words = f"true: {self.classes[clip.label]}, {chance:.2f}"
            left, top = _LABEL + _MAIN + _WEIGHT + 2 * _GAP, _HEAD + 0.36 * len(best) + 0.06
            self.text(left, top, words, fontsize=8.5, color=_RIGHT)

    def _seconds(self, clip: ShownClip) -> float | None:
        """Length of the stored clip, where any observation has a rate."""
        rates = {name: rate_of(self.store, name) for name in clip.observations}
        lengths = [len(clip.observations[name]) / rate for name, rate in rates.items() if rate is not None]
        return max(lengths, default=None)


def _draw_observed(axis: Axes, array: np.ndarray, end: float) -> None:
    there = seen(array)
    _bare(axis)
    axis.set_xlim(0, end)
    if not there.any():
        axis.set_facecolor("0.95")
        axis.text(0.5, 0.5, "missing", transform=axis.transAxes, ha="center", va="center", fontsize=9, color="0.45")
    elif array.ndim == 4:
        _draw_frames(axis, array, end)
    elif array.shape[1] <= _CHANNELS:
        time = (np.arange(len(array)) + 0.5) / len(array)
        for channel, values in enumerate(array.T):
            axis.plot(time, values, color=COLOURS[channel % len(COLOURS)], linewidth=0.9)
        axis.spines["bottom"].set_visible(True)
        axis.spines["bottom"].set_color("0.85")
    else:
        spread = np.nanstd(array, 0)
        shown = (array - np.nanmean(array, 0)) / np.where(spread > 0, spread, 1.0)
        axis.imshow(shown.T, cmap="Greys", aspect="auto", extent=(0, 1, 0, 1), interpolation="nearest", vmin=-2, vmax=2)
        axis.set_xlim(0, end)
        _bare(axis)


def _draw_frames(axis: Axes, video: np.ndarray, end: float) -> None:
    """Six frames at even distances, each at its share of the time that is drawn."""
    count = len(video)
    for place in range(_FRAMES):
        middle = (place + 0.5) / _FRAMES * end
        frame = video[min(int(middle * count), count - 1)]
        left, right = place / _FRAMES * end, (place + 1) / _FRAMES * end
        pixels = np.repeat(frame, 3, 0) if len(frame) == 1 else frame[:3]
        shown = pixels.transpose(1, 2, 0) if frame.any() else np.full((1, 1, 3), 242, np.uint8)
        gap = 0.012 * (right - left)
        axis.imshow(shown, extent=(left + gap, right - gap, 0, 1), aspect="auto", interpolation="nearest")
    axis.set_xlim(0, end)
    axis.set_ylim(0, 1)
    _bare(axis)


def _draw_attention(axis: Axes, weights: np.ndarray | None, end: float) -> None:
    """A strip; a step of twice the even share, or the strongest one, is darkest."""
    _bare(axis)
    axis.set_xlim(0, end)
    if weights is None or not weights.any():
        return
    darkest = max(float(weights.max()), 2.0 / np.count_nonzero(weights))
    axis.imshow(weights[None], cmap=_SHADE, vmin=0, vmax=darkest, aspect="auto", extent=(0, 1, 0, 1))
    axis.set_xlim(0, end)
    axis.set_ylim(0, 1)
    _bare(axis)


def _mark_time(axis: Axes, seconds: float | None, end: float) -> None:
    axis.set_xticks([0, end], ["0", "end" if seconds is None else f"{seconds * end:.1f} s"], fontsize=8, color="0.35")
    axis.tick_params(length=2, color="0.6")


def _bare(axis: Axes) -> None:
    axis.set_xticks([])
    axis.set_yticks([])
    axis.spines[:].set_visible(False)


def _broken(name: str) -> str:
    return name.replace("_", "\n")
