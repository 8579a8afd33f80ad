"""What is measured across the snapshots of an exploration: whether more pre-training helps."""

from __future__ import annotations

import math
import warnings
from collections.abc import Mapping

import numpy as np
from scipy import stats

from repdib_lightning.experiments.snapshots import ALL, MONOTONE
from repdib_lightning.experiments.suite import Finetune

_RANKED = "return"
_DIGITS = 10  # a perfect order is 1, not 0.9999999999999999


def snapshot_measures(metrics: Mapping[str, float], finetune: Finetune | None) -> dict[str, float]:
    """What follows from the fine-tunings of one point from several snapshots.

    - ``AGENT/NAME/...``: of the largest snapshot, so that it stands beside a run NAME from scratch;
    - ``AGENT/NAME/monotone``: Spearman's rank correlation between frames and return, 1 if more frames are always
      better; left out where it means nothing (one snapshot, a missing return, or all of them equal);
    - ``AGENT/all/monotone``: the mean over all NAMEs, where every one has it.

    Args:
        metrics: of the point, each fine-tuning's as ``AGENT/NAME_FRAMES/...``. finetune: its fine-tunings.
    """
    if finetune is None or not finetune.snapshots:
        return {}
    found: dict[str, float] = {}
    ranked = []
    for name, runs in finetune.snapshots.items():
        last = f"{finetune.agent}/{runs[max(runs)]}/"
        found |= {
            f"{finetune.agent}/{name}/{measure.removeprefix(last)}": value
            for measure, value in metrics.items()
            if measure.startswith(last)
        }
        returns = {count: metrics.get(f"{finetune.agent}/{run}/{_RANKED}") for count, run in runs.items()}
        value = rank_correlation(returns)
        if value is not None:
            found[f"{finetune.agent}/{name}/{MONOTONE}"] = value
            ranked.append(value)
    if len(ranked) == len(finetune.snapshots):
        found[f"{finetune.agent}/{ALL}/{MONOTONE}"] = float(np.mean(ranked))
    return found


def rank_correlation(returns: Mapping[int, float | None]) -> float | None:
    """Spearman's rank correlation between the keys and their values; None where there is none."""
    known = [value for value in returns.values() if value is not None]
    if len(known) < max(2, len(returns)):
        return None
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", stats.ConstantInputWarning)
        value = float(stats.spearmanr(list(returns), known).statistic)
    return round(value, _DIGITS) if math.isfinite(value) else None
