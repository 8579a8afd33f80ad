"""Data modules: a store, its splits and its loaders, as Lightning wants them."""

from __future__ import annotations

import shlex
import sys
from pathlib import Path
from typing import Any

import lightning.pytorch as pl
import torch
from torch.utils.data import DataLoader

from repdib_lightning.data.channel_statistics import training_statistics
from repdib_lightning.data.episodes import EpisodeStore
from repdib_lightning.data.held_out import as_names
from repdib_lightning.data.loading import FutureFrames, ResumableLoader, as_it_is, evaluation_batches
from repdib_lightning.data.resident import Mapped, Resident, Source
from repdib_lightning.data.sampling import FutureSampling
from repdib_lightning.errors import UserError, nearest
from repdib_lightning.records import ArraySpec, Batch, DataSpec, Split


class EpisodeDataModule(pl.LightningDataModule):
    """Anchor frames with futures from any store.

    Args:
        path: the store, an HDF5 file made by ``collect`` or ``import``.
        batch_size: anchors B of a step, over all processes; a step encodes B * (1 + futures) frames, B more
            with ``next_frame``.
        horizon: K, the largest time offset between an anchor and its futures, in steps. 1 gives one-step pairs.
        futures: futures drawn for each anchor; with 0 every row is a sample of its own, and no horizon is needed.
        frame_stack: S, frames stacked into one observation.
        views: observations to use; all by default.
        workers: loader processes; 0 reads in the training process, which is best while the file fits in memory.
        seed: of the order of samples.
        resident: keep the arrays that are used on the training device, as they are stored (a picture stays uint8), and
            gather the same batches there: fastest where the data fit its memory. They are loaded once, by the first
            batch; each process of a training keeps its own copy. Needs workers = 0. Off: read through memory maps.
        next_frame: put the frame after the anchor, t + 1, before the futures of every sample, whatever the horizon.
            What is drawn stays as it is. Objectives that predict the next latent need it; the others leave it aside.
        collect: words of a ``collect`` command that makes the file where it is absent, without the path, such as
            ``control --distractors video``.
        target: the categorical factor that is to be recognised, such as ``activity``; none where it is empty.
        held_out: names of values of categorical factors, such as {"subject": ["17", "18"]}: the episodes that have any
            of them are held out, whatever the file marks, and all others train.
        consecutive: anchors that follow each other in an episode and are drawn together for training. With
            ``model.encode_once`` they share most of their frames: with futures up to 8 steps on, runs of 8 anchors cost
            2 encoded frames an anchor instead of 6, for samples that are less different.
        leave_out_short: leave out episodes that are not longer than the horizon, and say how many, where they would
            otherwise be refused.
    """

    def __init__(
        self,
        path: str,
        batch_size: int = 128,
        horizon: int = 5,
        futures: int = 1,
        frame_stack: int = 1,
        views: list[str] | None = None,
        workers: int = 0,
        seed: int = 0,
        resident: bool = False,
        next_frame: bool = False,
        collect: str = "",
        target: str = "",
        held_out: dict[str, list[str | int]] | None = None,
        consecutive: int = 1,
        leave_out_short: bool = False,
    ) -> None:
        super().__init__()
        self.path = Path(path)
        self.batch_size, self.horizon, self.futures = batch_size, horizon, futures
        self.frame_stack, self.views, self.workers, self.seed = frame_stack, views, workers, seed
        self.resident, self.next_frame, self.collect = resident, next_frame, collect
        self.target, self.held_out = target, as_names(held_out)
        self.consecutive, self.leave_out_short = consecutive, leave_out_short
        bounds = (("batch_size", 1), ("horizon", 1), ("futures", 0), ("frame_stack", 1), ("consecutive", 1))
        for name, least in bounds:
            if getattr(self, name) < least:
                raise UserError(f"data.{name} must be at least {least}, is {getattr(self, name)}")
        if workers < 0 or seed < 0:
            raise UserError(f"data.workers and data.seed must not be negative, are {workers} and {seed}")
        if resident and workers:
            raise UserError(
                f"data.resident keeps the data in the training process, data.workers is {workers}: other processes "
                "cannot read there; set data.workers to 0"
            )
        if views is not None and not views:
            raise UserError("data.views is empty; name at least one observation, or leave the option out to use all")
        self.store: EpisodeStore | None = None
        self._kept: Resident | None = None

    def prepare_data(self) -> None:
        """Collect the file if it is absent and ``collect`` says how, and say so."""
        if self.collect.strip() and not self.path.exists():
            from repdib_lightning.verbs import collect

            environment, *options = shlex.split(self.collect)
            print(f"{self.path}: no such file; collecting {self.collect} there", file=sys.stderr, flush=True)
            collect([environment, str(self.path), *options])

    def setup(self, stage: str | None = None) -> None:
        """Open and validate the store. Raises UserError, naming file and key, where something is wrong."""
        if self.store is not None:
            return
        store = EpisodeStore(self.path, self.held_out)
        for view in self.views or []:
            if view not in store.observations:
                raise UserError(f"{self.path}: has no observation '{view}', {nearest(view, store.observations)}")
        if self.target:
            check_target(store, self.target)
        self.store = store
        self._measured = training_statistics(store, self._used_views())
        self._training = self._sampling("train")
        self._evaluation = self._sampling("evaluation")
        left_out = self._training.left_out + self._evaluation.left_out
        if left_out:
            told = f"{left_out} of {len(store.starts)} episodes are no longer than the horizon {self.horizon}"
            print(f"{self.path}: {told}: left out", file=sys.stderr, flush=True)

    def _sampling(self, split: Split) -> FutureSampling:
        assert self.store is not None
        return FutureSampling(
            self.store,
            split,
            horizon=self.horizon,
            futures=self.futures,
            seed=self.seed,
            next_frame=self.next_frame,
            consecutive=self.consecutive if split == "train" else 1,
            leave_out_short=self.leave_out_short,
        )

    @property
    def spec(self) -> DataSpec:
        """What a model must know of the data. Only after :meth:`setup`."""
        assert self.store is not None, "setup() opens the store first"
        observations = {}
        for name in self._used_views():
            array = self.store.observations[name]
            shape = (array.shape[0] * self.frame_stack, *array.shape[1:])
            measured = [tuple(part.tolist()) for part in self._measured.get(name, ())]
            observations[name] = ArraySpec(shape, array.dtype, *measured)
        horizon = self.horizon if self.futures else 0
        classes = tuple(self.store.value_names(self.target)) if self.target else ()
        actions = self.store.actions_spec
        return DataSpec(observations, actions, self.frame_stack, horizon, self.next_frame, self.target, classes)

    @property
    def facts(self) -> dict[str, Any]:
        """Plain facts of the data for a run's folder and for bundles. Only after :meth:`setup`."""
        assert self.store is not None, "setup() opens the store first"
        facts: dict[str, Any] = {"file": self.store.path.name, "fingerprint": self.store.fingerprint}
        return facts | ({"held_out": self.held_out} if self.held_out else {})

    def example(self, count: int = 2) -> Batch:
        """Some held-out samples, evenly spread, since neighbours may be alike. Only after :meth:`setup`."""
        assert self.store is not None
        held_out = len(self._evaluation)
        numbers = [number * held_out // count for number in range(count)] if count < held_out else list(range(held_out))
        return self._frames(self._evaluation, Mapped(self.store)).__getitems__(numbers)

    def train_dataloader(self) -> ResumableLoader:
        """Shuffled anchors of the training episodes, resumable at any batch."""
        rank, world_size = self._place()
        return ResumableLoader(
            self._frames(self._training, self._source()),
            self.batch_size,
            workers=self.workers,
            rank=rank,
            world_size=world_size,
            pin_memory=torch.cuda.is_available() and not self.resident,
        )

    def val_dataloader(self) -> DataLoader[Batch]:
        """Anchors of the evaluation episodes, each once, in the same order each time."""
        dataset = self._frames(self._evaluation, self._source())
        batches = evaluation_batches(len(dataset), self.batch_size, *self._place())
        return DataLoader(dataset, batch_sampler=batches, collate_fn=as_it_is, num_workers=self.workers)

    def test_dataloader(self) -> DataLoader[Batch]:
        """Same as :meth:`val_dataloader`."""
        return self.val_dataloader()

    def _place(self) -> tuple[int, int]:
        return (self.trainer.global_rank, self.trainer.world_size) if self.trainer else (0, 1)

    def _used_views(self) -> list[str]:
        assert self.store is not None
        return self.views or list(self.store.observations)

    def _source(self) -> Source:
        """The file, or what is kept of it on the device of the trainer (the CPU if there is none)."""
        assert self.store is not None
        if not self.resident:
            return Mapped(self.store)
        device = self.trainer.strategy.root_device if self.trainer else torch.device("cpu")
        if self._kept is None or self._kept.device != device:
            names = [f"observations/{view}" for view in self._used_views()]
            if self.store.actions_spec is not None:
                names.append("actions")
            if self.target:
                names.append(f"factors/{self.target}")
            self._kept = Resident(self.store, names, device)
        return self._kept

    def _frames(self, sampling: FutureSampling, source: Source) -> FutureFrames:
        assert self.store is not None
        return FutureFrames(self.store, sampling, self.frame_stack, self._used_views(), source, self.target)


def check_target(store: EpisodeStore, target: str) -> None:
    """Raise UserError, naming the file, unless the target is a categorical factor of the store."""
    known = [name for name, spec in store.factors.items() if spec.scale == "categorical"]
    if target not in known:
        what = f"factor '{target}' is continuous" if target in store.factors else f"has no factor '{target}'"
        hint = nearest(target, known) or "the file has no categorical factor"
        raise UserError(f"{store.path}: data.target: {what}, {hint}")
