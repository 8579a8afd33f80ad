"""Which evaluation episodes a probe is fitted on, and which it is scored on."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from repdib_lightning.data.episodes import EpisodeStore
from repdib_lightning.errors import UserError


@dataclass(frozen=True)
class ProbeSplit:
    """Two disjoint halves of the evaluation episodes.

    Attributes:
        fit, score: (E,) int64 episode indices.
        fit_rows, score_rows: (n,) int64 rows of the store.
    """

    fit: np.ndarray
    score: np.ndarray
    fit_rows: np.ndarray
    score_rows: np.ndarray

    @property
    def rows(self) -> np.ndarray:
        """(n,) int64: all evaluation rows, in the order of the store."""
        return np.sort(np.concatenate([self.fit_rows, self.score_rows]))


def split_evaluation(store: EpisodeStore) -> ProbeSplit:
    """Deal the evaluation episodes alternately into a fit and a score half, so that a slow drift covers both.

    The paper names no hold-out split for its probes; neighbouring frames are near copies of each other, so only
    whole episodes are held out.

    Raises:
        UserError: the store has fewer than two evaluation episodes.
    """
    episodes = store.episodes("evaluation")
    if len(episodes) < 2:
        raise UserError(
            f"{store.path}: a probe needs at least 2 evaluation episodes (one to fit, one to score), has "
            f"{len(episodes)} of {len(store.starts)}; mark more in 'episodes/evaluation'"
        )
    fit, score = episodes[0::2], episodes[1::2]
    return ProbeSplit(fit, score, rows_of(store, fit), rows_of(store, score))


def rows_of(store: EpisodeStore, episodes: np.ndarray) -> np.ndarray:
    """(E,) episode indices to the (n,) int64 rows they hold."""
    parts = [np.arange(store.starts[e], store.starts[e] + store.lengths[e]) for e in episodes]
    return np.concatenate([np.empty(0, np.int64), *parts])


def episode_folds(episodes: np.ndarray, folds: int = 4) -> list[np.ndarray]:
    """Inner validation sets that hold out whole episodes.

    A single episode cannot be split by episodes; its rows are then cut into contiguous blocks.

    Args:
        episodes: (n,) episode of each row, rows in the order of the store.
        folds: at most this many; fewer where there are fewer episodes.

    Returns:
        One (n,) bool mask of held-out rows a fold; every row is held out exactly once.
    """
    names, group = np.unique(episodes, return_inverse=True)
    if len(names) == 1:
        group = np.arange(len(episodes)) * folds // len(episodes)
    count = min(folds, len(np.unique(group)))
    assert count >= 2, "an inner split needs at least two rows"
    return [group % count == fold for fold in range(count)]
