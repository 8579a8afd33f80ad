"""Which clips a figure shows: by a fixed rule, so that nobody picks the pretty ones."""

from __future__ import annotations

import numpy as np


def chosen_clips(labels: np.ndarray, predicted: np.ndarray, count: int) -> list[int]:
    """Indices of at most so many of (n,) clips, in the order in which they are shown.

    Classes are spread evenly over those that occur, from the first to the last, and taken again when all are shown; of
    each the first clip that was recognised and is not shown yet (or the first at all, where none was). The last place
    is for the first clip that was mistaken, where there is one and none is shown.

    Args:
        labels, predicted: (n,) int64, true and told classes.
        count: at least 1.
    """
    occurring = np.unique(labels)
    # The next clip of a class is looked for among the recognised ones first.
    queues = {kind: _right_first(np.flatnonzero(labels == kind), labels == predicted) for kind in occurring}
    wanted = min(count, len(labels))
    found: list[int] = []
    spread = occurring[np.linspace(0, len(occurring) - 1, min(wanted, len(occurring))).round().astype(int)]
    order = [*spread, *(kind for kind in occurring if kind not in spread)]
    while len(found) < wanted:
        found += [queues[kind].pop(0) for kind in order if queues[kind]][: wanted - len(found)]
    wrong = np.flatnonzero(labels != predicted)
    if len(wrong) and not np.isin(found, wrong).any():
        found[-1] = int(wrong[0])
    return found


def _right_first(clips: np.ndarray, right: np.ndarray) -> list[int]:
    return [*clips[right[clips]].tolist(), *clips[~right[clips]].tolist()]
