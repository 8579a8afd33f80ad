"""Batches from a store: one gather a batch, and a stream that goes on exactly where it was left."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import torch
from torch.utils.data import DataLoader, Dataset

from repdib_lightning.data.episodes import EpisodeStore
from repdib_lightning.data.resident import Mapped, Source
from repdib_lightning.data.sampling import FutureSampling, stacked_rows
from repdib_lightning.errors import UserError
from repdib_lightning.records import Batch


class FutureFrames(Dataset[Batch]):
    """Samples as tensors. Indexed by lists of sample numbers, so that a batch is one gather for each view.

    Args:
        store: the data.
        sampling: which rows make a sample.
        frame_stack: S.
        views: observations to read.
        source: where their rows, those of the actions and of the target are gathered from; the memory-mapped file by
            default.
        target: the categorical factor whose class at the anchor is to be recognised; none where it is empty.
    """

    def __init__(
        self,
        store: EpisodeStore,
        sampling: FutureSampling,
        frame_stack: int,
        views: list[str],
        source: Source | None = None,
        target: str = "",
    ) -> None:
        self.store, self.sampling, self.target = store, sampling, target
        self.frame_stack, self.views = frame_stack, views
        self.source = source or Mapped(store)

    def __len__(self) -> int:
        return len(self.sampling)

    def __getitem__(self, number: int) -> Batch:
        return self.__getitems__([number])

    def __getitems__(self, numbers: list[int]) -> Batch:
        """Gather the samples with these numbers in the stream as one :class:`Batch`."""
        anchors, offsets = self.sampling.draw(np.asarray(numbers, np.int64))
        newest = (anchors[:, None] + offsets).reshape(-1)
        rows = stacked_rows(self.store, newest, self.frame_stack).reshape(-1)
        observations = {}
        for name in self.views:
            frames = self.source.gather(f"observations/{name}", rows)
            observations[name] = frames.reshape(*offsets.shape, -1, *frames.shape[2:])
        actions = self.source.gather("actions", anchors) if self.store.actions_spec is not None else None
        targets = self.source.gather(f"factors/{self.target}", anchors).reshape(-1) if self.target else None
        return Batch(observations, actions, torch.from_numpy(offsets), torch.from_numpy(anchors), targets)


class ResumableLoader:
    """An endless stream of batches, cut into epochs, that continues where its state says.

    Batch b of epoch e holds the samples ``e * len(dataset) + b * batch_size + ...`` of the stream; with several ranks
    each takes a contiguous part of every global batch, so that together they see what one process would, in its order.
    The last, incomplete batch of an epoch is left out. Worker processes live on from epoch to epoch.

    Args:
        dataset: indexed by lists of sample numbers.
        batch_size: samples of a GLOBAL batch (over all ranks).
        workers: worker processes; 0 gathers in the training process.
        rank, world_size: this process and how many there are.
        pin_memory: for copies to a GPU.

    Raises:
        UserError: the batch size exceeds the data set or is not divisible by the number of ranks.
    """

    def __init__(
        self,
        dataset: FutureFrames,
        batch_size: int,
        *,
        workers: int = 0,
        rank: int = 0,
        world_size: int = 1,
        pin_memory: bool = False,
    ) -> None:
        if not 1 <= batch_size <= len(dataset):
            raise UserError(f"batch_size is {batch_size}, the data has {len(dataset)} samples")
        if batch_size % world_size:
            raise UserError(f"batch_size {batch_size} cannot be shared by {world_size} processes")
        self.dataset, self.batch_size, self.workers = dataset, batch_size, workers
        self.rank, self.world_size, self.pin_memory = rank, world_size, pin_memory
        self.epoch = self.batch = 0
        self._stream: Iterator[Batch] | None = None

    def __len__(self) -> int:
        """Batches of one epoch."""
        return len(self.dataset) // self.batch_size

    def __iter__(self) -> Iterator[Batch]:
        """Yield what is left of the current epoch."""
        if self.batch >= len(self):
            self.epoch, self.batch = self.epoch + 1, 0
        if self._stream is None:
            self._stream = iter(self._open())
        while self.batch < len(self):
            yield self._next()

    def _next(self) -> Batch:
        """One batch, to which no name here refers while the next one is made: that would be memory for one more."""
        assert self._stream is not None
        batch = next(self._stream)
        self.batch += 1
        return batch

    def _open(self) -> DataLoader[Batch]:
        return DataLoader(
            self.dataset,
            batch_sampler=_SampleNumbers(self),
            num_workers=self.workers,
            collate_fn=as_it_is,
            pin_memory=self.pin_memory,
            generator=torch.Generator().manual_seed(0),  # workers draw nothing; the global generator stays untouched
        )

    def state_dict(self) -> dict[str, Any]:
        """Epoch, batches consumed of it, and what must not change between save and resume."""
        return {"epoch": self.epoch, "batch": self.batch, "batch_size": self.batch_size, "samples": len(self.dataset)}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue after the batch that the state names.

        Raises:
            UserError: the batch size or the number of samples has changed.
        """
        for key, now in (("batch_size", self.batch_size), ("samples", len(self.dataset))):
            if state[key] != now:
                raise UserError(f"resume: {key} was {state[key]} when the checkpoint was written, is {now} now")
        self.epoch, self.batch = state["epoch"], state["batch"]
        self._stream = None


class _SampleNumbers:
    """Endless lists of a rank's sample numbers from a given batch on.

    It keeps numbers and not the loader: a loader that its own stream refers to would be freed by the garbage collector,
    whose order of finalisers leaves worker processes waiting for seconds.
    """

    def __init__(self, loader: ResumableLoader) -> None:
        self.samples, self.batches, self.batch_size = len(loader.dataset), len(loader), loader.batch_size
        self.share = loader.batch_size // loader.world_size
        self.offset = loader.rank * self.share
        self.epoch, self.batch = loader.epoch, loader.batch

    def __iter__(self) -> Iterator[list[int]]:
        epoch, batch = self.epoch, self.batch
        while True:
            first = epoch * self.samples + batch * self.batch_size + self.offset
            yield list(range(first, first + self.share))
            batch += 1
            if batch == self.batches:
                epoch, batch = epoch + 1, 0


def evaluation_batches(samples: int, batch_size: int, rank: int = 0, world_size: int = 1) -> list[list[int]]:
    """Sample numbers of each batch of one process, which together hold every sample once.

    Together the processes see the batches that one would see, which losses that compare samples depend on. Each has
    as many batches as the others, of sizes that differ by one at most: none is padded, and none waits for another that
    has ended.

    Raises:
        UserError: fewer samples than processes.
    """
    if samples < world_size:
        raise UserError(f"the held-out episodes have {samples} samples, too few for {world_size} processes")
    count = min(-(-samples // batch_size), samples // world_size)
    return [part[rank::world_size].tolist() for part in np.array_split(np.arange(samples), count)]


def as_it_is(batch: Any) -> Any:
    """The collate function of data sets that gather whole batches."""
    return batch
