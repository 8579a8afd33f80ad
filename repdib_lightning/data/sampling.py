"""Which rows make a sample: index arithmetic on a store, and nothing else.

Everything drawn is a function of (seed, sample number): workers, ranks and restarts change nothing.
"""

from __future__ import annotations

import numpy as np

from repdib_lightning.data.episodes import EpisodeStore
from repdib_lightning.errors import UserError
from repdib_lightning.records import Split


def stacked_rows(store: EpisodeStore, rows: np.ndarray, frame_stack: int) -> np.ndarray:
    """Rows of each frame stack, oldest first; before an episode's start its first row is repeated.

    Args:
        store: where the rows live.
        rows: (n,) int64, the newest frame of each stack.
        frame_stack: S.

    Returns:
        (n, S) int64.
    """
    first = store.starts[store.row_episodes[rows]]
    return np.maximum(rows[:, None] - np.arange(frame_stack - 1, -1, -1), first[:, None])


def gather_stacks(store: EpisodeStore, name: str, rows: np.ndarray, frame_stack: int) -> np.ndarray:
    """Observations of the given rows with S frames as channels: (n,) int64 -> (n, S * C, ...)."""
    if frame_stack == 1:
        return store.gather(f"observations/{name}", rows)
    stacks = store.gather(f"observations/{name}", stacked_rows(store, rows, frame_stack).reshape(-1))
    return stacks.reshape(len(rows), -1, *stacks.shape[2:])


class FutureSampling:
    """An endless stream of samples: anchors t, each with n futures t + k, k uniform in 1..K.

    Each epoch visits every anchor once, in an order drawn from (seed, epoch). An anchor is a row with at least K
    later rows in its episode, so that k is uniform for all of them (AC-State, Lamb et al. 2022; paper section 4.4).
    Without futures every row is an anchor, also that of an episode of one row.

    Args:
        store: the data.
        split: which episodes.
        horizon: K.
        futures: n, so a sample has F = 1 + n frames; 0 where what is learned needs no later frame.
        seed: of the stream.
        next_frame: a sample has F = 2 + n frames, of which the second is t + 1, whatever K. The order and the n futures
            drawn are those without it.
        consecutive: T, how many anchors that follow each other are drawn together; the order is drawn of these runs,
            whose beginnings differ between epochs. 1 draws each anchor by itself.
        leave_out_short: leave out episodes that are not longer than the horizon.

    Attributes:
        anchors: (A,) int64, their rows. left_out: episodes that were too short.

    Raises:
        UserError: an episode is not longer than the horizon, or, where these are left out, none is; or the split is
            empty.
    """

    def __init__(
        self,
        store: EpisodeStore,
        split: Split,
        *,
        horizon: int,
        futures: int,
        seed: int,
        next_frame: bool = False,
        consecutive: int = 1,
        leave_out_short: bool = False,
    ) -> None:
        if horizon < 1 or futures < 0:
            raise UserError(f"horizon ({horizon}) must be at least 1, futures ({futures}) not negative")
        ahead = horizon if futures else int(next_frame)
        episodes = store.episodes(split)
        if not len(episodes):
            raise UserError(_empty_split(store, split))
        short = episodes[store.lengths[episodes] <= ahead]
        if len(short) and not (leave_out_short and len(short) < len(episodes)):
            raise UserError(_too_short(store, episodes, short, ahead, left_out=leave_out_short, next_frame=next_frame))
        self.left_out = len(short)
        episodes = np.setdiff1d(episodes, short, assume_unique=True)
        spans = [np.arange(store.starts[e], store.starts[e] + store.lengths[e] - ahead) for e in episodes]
        self.anchors = np.concatenate(spans)
        self.consecutive = consecutive
        self._places = np.concatenate([np.arange(len(span)) for span in spans])  # of each anchor in its episode
        self._episodes = np.repeat(np.arange(len(spans)), [len(span) for span in spans])
        self.horizon, self.futures, self.seed, self.next_frame = horizon, futures, seed, next_frame
        self._epoch = -1

    def __len__(self) -> int:
        """Samples of one epoch."""
        return len(self.anchors)

    def draw(self, numbers: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Rows and offsets of samples given by their numbers in the stream.

        Args:
            numbers: (n,) int64, epoch * len(self) + position.

        Returns:
            anchor rows (n,) int64, and offsets (n, F) int64 with a leading 0, or 0 and 1 with ``next_frame``.
        """
        epochs, positions = np.divmod(numbers, len(self))
        rows = np.empty(len(numbers), np.int64)
        fixed = [0, 1] if self.next_frame else [0]
        offsets = np.empty((len(numbers), len(fixed) + self.futures), np.int64)
        offsets[:, : len(fixed)] = fixed
        for epoch in np.unique(epochs):
            self._prepare(int(epoch))
            here = epochs == epoch
            rows[here] = self._order[positions[here]]
            offsets[here, len(fixed) :] = self._offsets[positions[here]]
        return rows, offsets

    def _prepare(self, epoch: int) -> None:
        if epoch != self._epoch:
            generator = np.random.Generator(np.random.Philox(key=np.array([self.seed, epoch], np.uint64)))
            alone = self.consecutive == 1
            self._order = generator.permutation(self.anchors) if alone else self._in_runs(generator)
            self._offsets = generator.integers(1, self.horizon + 1, (len(self), self.futures))
            self._epoch = epoch

    def _in_runs(self, generator: np.random.Generator) -> np.ndarray:
        """All anchors, runs of T of an episode at once; the first and the last of an episode may be shorter."""
        phases = generator.integers(self.consecutive, size=int(self._episodes[-1]) + 1)
        runs = (self._places + phases[self._episodes]) // self.consecutive
        begins = np.flatnonzero(np.diff(runs, prepend=-1) | np.diff(self._episodes, prepend=-1))
        lengths = np.diff(begins, append=len(self.anchors))
        order = generator.permutation(len(begins))
        ends = np.cumsum(lengths[order])
        within = np.arange(len(self.anchors)) - np.repeat(ends - lengths[order], lengths[order])
        return self.anchors[np.repeat(begins[order], lengths[order]) + within]


def _empty_split(store: EpisodeStore, split: Split) -> str:
    if split == "evaluation":
        whole = "recordings" if "episodes/recording" in store else "episodes"
        hint = f"mark some in `episodes/evaluation`, or have at least 5 {whole} (every fifth is held out then)"
    else:
        hint = "all are marked in `episodes/evaluation`; leave some for training"
    return f"{store.path}: has no episode for {split} ({len(store.lengths)} in all): {hint}"


def _too_short(
    store: EpisodeStore, episodes: np.ndarray, short: np.ndarray, horizon: int, *, left_out: bool, next_frame: bool
) -> str:
    lengths = store.lengths[episodes]
    if left_out and lengths.max() > 1:  # then all are too short
        return (
            f"{store.path}: no episode has as many steps as the horizon {horizon}; the longest has {lengths.max() - 1}"
        )
    if lengths.min() == 1:
        return _one_row(store, int(episodes[np.argmin(lengths)]), next_frame=next_frame)
    return (
        f"{store.path}: episode {short[0]} has {store.lengths[short[0]] - 1} steps, fewer than the horizon {horizon}; "
        f"the largest valid horizon is {lengths.min() - 1}, or leave such episodes out by data.leave_out_short"
    )


def _one_row(store: EpisodeStore, episode: int, *, next_frame: bool) -> str:
    way_out = "set data.futures to 0" + (" and data.next_frame to false" if next_frame else "")
    if (store.lengths == 1).all():
        return f"{store.path}: every episode has one row, such as a picture, and no later row to draw; {way_out}"
    return (
        f"{store.path}: episode {episode} has one row and therefore no step, so that no horizon is valid; {way_out}, "
        "with which every row is a sample, or leave this episode out when the file is written"
    )
