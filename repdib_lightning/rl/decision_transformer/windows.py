"""Windows of consecutive steps of a store: index arithmetic, returns-to-go, and the order in which they are drawn."""

from __future__ import annotations

import numpy as np

from repdib_lightning.data.episodes import EpisodeStore
from repdib_lightning.errors import UserError


class Windows:
    """Every window of ``context`` steps inside one training episode.

    A step is a row with an action. Windows begin at the first step of an episode and every ``stride`` steps after it,
    until one reaches the last step. What lies behind that is padding: an episode that is shorter than the context, or
    the rest behind the last whole stride, counts too. With a stride of 1 a step is in as many windows as can be; with
    one of ``context``, in one. The published program has a window for each step but the last ``context`` of the data;
    one that would reach over an episode's end is moved back, into the episode before where this one is short.

    Args:
        store: with discrete actions and rewards.
        context: T.
        stride: steps between the beginnings of two windows; at most ``context``.

    Attributes:
        starts: (W,) int64, row of each window's first step. lengths: (W,) int64, steps that are no padding.
        timesteps: (W,) int64, time in its episode of the first step. episode_starts: (W,) int64, row of that.
        returns: (N,) float32, undiscounted return-to-go of each row of a training episode. actions: (N,) int64.
        trained: (N,) bool, whether a row is a step of a training episode.
        beginnings: most windows of an episode. best_return: of the training episodes.

    Raises:
        UserError: no discrete actions, no finite rewards, no step to train on.
    """

    def __init__(self, store: EpisodeStore, context: int, stride: int = 1) -> None:
        assert 1 <= stride <= context
        check_actions(store)
        episodes = store.episodes("train")
        first, steps = store.starts[episodes], store.lengths[episodes] - 1
        first, steps = first[steps > 0], steps[steps > 0]
        if not len(steps):
            raise UserError(f"{store.path}: has no episode with a step to train on ({len(store.starts)} episodes)")
        self.context = context
        counts = -(-np.maximum(steps - context, 0) // stride) + 1
        number = np.arange(counts.sum()) - np.repeat(np.cumsum(counts) - counts, counts)  # of a window in its episode
        self.timesteps = stride * number
        self.episode_starts = np.repeat(first, counts)
        self.starts = self.episode_starts + self.timesteps
        self.lengths = np.minimum(np.repeat(steps, counts) - self.timesteps, context)
        self.actions = np.array(store.array("actions")[:], np.int64).reshape(-1)
        change = np.zeros(store.rows + 1, np.int64)
        change[first] += 1
        change[first + steps] -= 1
        self.trained = np.cumsum(change[:-1]) > 0
        self.returns = _returns_to_go(store, self.trained, np.repeat(first + steps, steps))
        self.beginnings = int(counts.max())
        self.best_return = float(self.returns[first].max())

    def __len__(self) -> int:
        return len(self.starts)

    def rows(self, windows: np.ndarray) -> np.ndarray:
        """Rows of the steps of some windows, (n,) to (n, T); padding repeats the last step."""
        return self._rows(windows, np.arange(self.context))

    def stacked_rows(self, windows: np.ndarray, frame_stack: int) -> np.ndarray:
        """The same with the S - 1 rows before, (n,) to (n, S - 1 + T): step t has the stack of columns t to t + S - 1.

        Before an episode's start its first row is repeated.
        """
        rows = self._rows(windows, np.arange(1 - frame_stack, self.context))
        return np.maximum(rows, self.episode_starts[windows][:, None])

    def _rows(self, windows: np.ndarray, steps: np.ndarray) -> np.ndarray:
        return self.starts[windows][:, None] + np.minimum(steps, self.lengths[windows][:, None] - 1)


class WindowOrder:
    """Which windows make each batch: a function of (seed, number of the batch) alone.

    An epoch takes every window once, in an order of its own. With a number of batches an epoch, windows are drawn on
    across epochs instead: none comes again before all others came.

    Args:
        windows: W. batch_size: B. batches: an epoch; None for every window once. seed: of the orders.

    Attributes:
        batches: an epoch. samples: windows an epoch.
    """

    def __init__(self, windows: int, batch_size: int, batches: int | None, seed: int) -> None:
        self._windows, self._batch_size, self._seed = windows, batch_size, seed
        self.samples = windows if batches is None else batches * batch_size
        self.batches = -(-self.samples // batch_size)
        self._pass, self._order = -1, np.arange(0)

    def batch(self, number: int) -> np.ndarray:
        """Windows of a batch, (B,) int64; the last of an epoch may be smaller."""
        epoch, place = divmod(number, self.batches)
        within = np.arange(place * self._batch_size, min((place + 1) * self._batch_size, self.samples))
        passes, places = np.divmod(epoch * self.samples + within, self._windows)
        drawn = np.empty(len(places), np.int64)
        for number_of_pass in np.unique(passes):
            here = passes == number_of_pass
            drawn[here] = self._ordered(int(number_of_pass))[places[here]]
        return drawn

    def _ordered(self, number: int) -> np.ndarray:
        if number != self._pass:
            random = np.random.Generator(np.random.Philox(key=np.array([self._seed, number], np.uint64)))
            self._pass, self._order = number, random.permutation(self._windows)
        return self._order


def check_actions(store: EpisodeStore) -> None:
    """Raise UserError unless a store has discrete actions, and rewards."""
    if store.actions_spec is None or store.actions_spec.kind != "discrete":
        kind = "there are none" if store.actions_spec is None else f"these are {store.actions_spec.kind}"
        raise UserError(f"{store.path}: finetune dt needs discrete actions, {kind}")
    if "rewards" not in store:
        raise UserError(f"{store.path}: has no 'rewards', of which finetune dt makes the returns that it asks for")


def _returns_to_go(store: EpisodeStore, trained: np.ndarray, ends: np.ndarray) -> np.ndarray:
    """(N,) float32: the sum of rewards from each trained row to the end of its episode; 0 in other rows.

    Args:
        store: the data. trained: (N,) bool. ends: for each trained row, that of its episode's final observation.
    """
    rewards = np.asarray(store.array("rewards")[:], np.float64)
    if rewards.size != store.rows:
        raise UserError(f"{store.path}: 'rewards' has shape {rewards.shape}, expected ({store.rows},)")
    rewards = np.where(trained, rewards.reshape(-1), 0.0)
    bad = np.flatnonzero(~np.isfinite(rewards))
    if len(bad):
        raise UserError(f"{store.path}: 'rewards' is NaN or infinite at row {bad[0]}; {len(bad)} such rows")
    later = np.append(np.cumsum(rewards[::-1])[::-1], 0.0)  # all that follow in the file
    returns = np.zeros(store.rows, np.float32)
    returns[trained] = later[:-1][trained] - later[ends]
    return returns
