"""What a decoder draws when groups of the latent are zeroed or swapped, judged by a frozen classifier."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from repdib_lightning.data.episodes import EpisodeStore
from repdib_lightning.evaluation.factor_classifier import Judge, judge_of
from repdib_lightning.evaluation.redrawing import Redrawing, psnr
from repdib_lightning.evaluation.splits import rows_of

PAIRS = 1000
_ROWS = 256


@dataclass(frozen=True)
class Verdict:
    """What the judge sees of one factor.

    Attributes:
        held_out: accuracy on held-out pictures: the most to expect. drawn: on what is drawn of them.
        chance: share of the most frequent class.
        donor: G shares of pairs, differing in this factor, where a swap of the group made the judge see the donor's
            class. own: where it still sees the picture's own.
        unswapped: share of the same pairs where it sees the donor's class without a swap: what a decoder that draws the
            same whatever the latent gets for ``donor``.
    """

    held_out: float
    drawn: float
    chance: float
    donor: list[float]
    own: list[float]
    unswapped: float


@dataclass(frozen=True)
class DrawingReport:
    """Quality and meaning of what is drawn of held-out pictures.

    Attributes:
        psnr: in dB. psnr_mean: of the mean training picture. psnr_zeroed: G numbers, with a group set to 0.
        verdicts: categorical factor -> verdict; none of a factor with one held-out class, or of frame stacks.
    """

    psnr: float
    psnr_mean: float
    psnr_zeroed: list[float]
    verdicts: dict[str, Verdict]

    def to_dict(self) -> dict[str, Any]:
        """Plain dictionaries, lists and numbers (JSON)."""
        return asdict(self)

    def figures(self) -> dict[str, float | None]:
        """The scores by name.

        ``judged`` is the judge's own accuracy on pictures; ``moved`` the donor's share of the group that moves a factor
        most, to be read against ``moved_unswapped``.
        """
        gain = self.psnr - self.psnr_mean
        found: dict[str, float | None] = {"psnr": self.psnr, "psnr_gain": gain}
        lost = sorted((self.psnr - zeroed for zeroed in self.psnr_zeroed), reverse=True)
        found |= {"psnr_lost_most": lost[0], "psnr_lost_least": lost[-1]}
        for factor, verdict in self.verdicts.items():
            moved = sorted(verdict.donor, reverse=True)
            found |= {f"{factor}/judged": verdict.held_out, f"{factor}/drawn": verdict.drawn}
            found[f"{factor}/moved"] = moved[0]
            found[f"{factor}/moved_unswapped"] = verdict.unswapped
            if len(moved) > 1:
                found[f"{factor}/moved_gap"] = moved[0] - moved[1]
        return found


def measure_drawing(
    drawn: Redrawing, store: EpisodeStore, rows: np.ndarray, seed: int, progress: bool = True
) -> DrawingReport:
    """Draw held-out rows, edit their groups, and ask the judge.

    Args:
        drawn: of these rows. store: with training pictures for the mean picture and the judge. rows: (n,) held out.
        seed: of the pairs whose groups are swapped.
        progress: show a progress bar while the judge is trained.
    """
    view, layout = drawn.decoder.view, drawn.layout
    full = drawn.draw()
    stack = drawn.encoder.spec.frame_stack
    mean = np.tile(mean_training_picture(store, view), (stack, 1, 1))
    zeroed = [psnr(drawn.draw(layout.zeroed(drawn.latents, group)), drawn.pictures) for group in range(layout.groups)]
    factors = [name for name, spec in store.factors.items() if spec.scale == "categorical"]
    verdicts = {}
    if factors and stack == 1:
        truth = {name: store.gather(f"factors/{name}", rows) for name in factors}
        verdicts = _verdicts(judge_of(store, view, factors, progress=progress), drawn, full, truth, seed)
    blank = np.broadcast_to(mean, drawn.pictures.shape)
    return DrawingReport(psnr(full, drawn.pictures), psnr(blank, drawn.pictures), zeroed, verdicts)


def mean_training_picture(store: EpisodeStore, view: str) -> np.ndarray:
    """The mean of all training pictures of a view, (C, H, W) uint8."""
    rows = rows_of(store, store.episodes("train"))
    total = np.zeros(store.observations[view].shape)
    for start in range(0, len(rows), _ROWS):
        total += store.gather(f"observations/{view}", rows[start : start + _ROWS]).sum(0, dtype=np.int64)
    return np.round(total / len(rows)).astype(np.uint8)


def _verdicts(
    judge: Judge, drawn: Redrawing, full: np.ndarray, truth: dict[str, np.ndarray], seed: int
) -> dict[str, Verdict]:
    random = np.random.default_rng(seed)
    count = len(drawn.latents)
    first, second = random.integers(count, size=(2, PAIRS))
    of_drawn = judge.tell(full)
    swapped = [
        judge.tell(drawn.draw(drawn.layout.swapped(drawn.latents[first], drawn.latents[second], group)))
        for group in range(drawn.layout.groups)
    ]
    found = {}
    for name, values in truth.items():
        own, donor = values[first], values[second]
        apart = own != donor
        if not apart.any():
            continue
        found[name] = Verdict(
            held_out=judge.accuracy[name],
            drawn=float(np.mean(of_drawn[name] == values)),
            chance=float(np.bincount(values).max() / count),
            donor=[float(np.mean(told[name][apart] == donor[apart])) for told in swapped],
            own=[float(np.mean(told[name][apart] == own[apart])) for told in swapped],
            unswapped=float(np.mean(of_drawn[name][first][apart] == donor[apart])),
        )
    return found
