"""Which evaluation episodes a probe is fitted on, and which it is scored on."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from repdib_lightning.data.clips import holds_clips
from repdib_lightning.data.episodes import EpisodeStore
from repdib_lightning.errors import UserError


@dataclass(frozen=True)
class ProbeSplit:
    """Two disjoint halves of the evaluation episodes, which share no recording.

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
    """Deal the evaluation recordings alternately into a fit and a score half, so that a slow drift covers both.

    Recordings of clips are dealt in a random order, always the same: files list activities in turn, and every second
    clip would be of every second activity.

    A recording is an episode, or all episodes that were cut of it. The paper names no hold-out split for its probes;
    neighbouring frames are near copies of each other, so only whole recordings are held out.

    Raises:
        UserError: the store has fewer than two evaluation recordings, or the fit half a single row, of which no inner
            split can be made.
    """
    episodes = store.episodes("evaluation")
    number, of_episode = np.unique(store.recordings[episodes], return_inverse=True)
    cut = "episodes/recording" in store
    whole = "evaluation recordings" if cut else "evaluation episodes"
    if len(number) < 2:
        raise UserError(
            f"{store.path}: a probe needs at least 2 {whole} (one to fit, one to score), has "
            f"{len(number)} of {len(np.unique(store.recordings))}; {_hold_out_more(store)}"
        )
    if holds_clips(store):
        of_episode = np.random.default_rng(0).permutation(len(number))[of_episode]
    fit, score = episodes[of_episode % 2 == 0], episodes[of_episode % 2 == 1]
    split = ProbeSplit(fit, score, rows_of(store, fit), rows_of(store, score))
    if len(split.fit_rows) < 2:
        raise UserError(
            f"{store.path}: a probe needs at least 2 rows to fit, has 1 (of {len(episodes)} evaluation episodes "
            f"every second is scored); {_hold_out_more(store)}"
        )
    return split


def _hold_out_more(store: EpisodeStore) -> str:
    return "mark more in 'episodes/evaluation'" if store.held_out is None else "name more values in held_out"


def rows_of(store: EpisodeStore, episodes: np.ndarray) -> np.ndarray:
    """(E,) episode indices to the (n,) int64 rows they hold."""
    parts = [np.arange(store.starts[e], store.starts[e] + store.lengths[e]) for e in episodes]
    return np.concatenate([np.empty(0, np.int64), *parts])


def episode_folds(episodes: np.ndarray, folds: int = 4) -> list[np.ndarray]:
    """Inner validation sets that hold out whole episodes, or recordings.

    A single one cannot be split that way; its rows are then cut into contiguous blocks.

    Args:
        episodes: (n,) episode, or recording, of each row, rows in the order of the store.
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
