"""A resumed run goes on bit for bit as though it had never stopped."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import lightning.pytorch as pl
from lightning.pytorch.callbacks import Checkpoint
from lightning.pytorch.trainer.states import TrainerFn
from lightning.pytorch.utilities.rank_zero import rank_zero_warn

from repdib_lightning.callbacks import generators
from repdib_lightning.callbacks.loop_progress import Progress
from repdib_lightning.errors import UserError

_KEY = "exact_resume"


class ExactResume(Checkpoint):
    """Adds to every checkpoint what Lightning leaves out, and puts it back on resume.

    That is: the states of all random number generators (Python, numpy, torch, GPU; of every rank), where training
    stands in a form that Lightning resumes rightly, and the position of the training data.

    Exact are checkpoints taken between two batches, as :class:`RunCheckpoint` takes them. Two things are asked of the
    rest: the training loader has ``state_dict`` and ``load_state_dict``, and draws nothing from the global generators;
    the module draws in ``training_step``, not in its batch transfer hooks. It subclasses Lightning's ``Checkpoint``
    only so that it runs after all other callbacks.
    """

    def __init__(self) -> None:
        self.progress = Progress()
        self._loader_states: list[dict[str, Any]] = []
        self._generators: dict[str, Any] | None = None
        self._resumed = False

    def on_train_batch_end(self, trainer: pl.Trainer, pl_module: pl.LightningModule, *_: Any) -> None:
        """Note the position: later, the next batch will have been fetched already."""
        self.progress = Progress.after_batch(trainer)
        self._loader_states = [loader.state_dict() for loader in _resumable_loaders(trainer)]

    def on_train_epoch_end(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Close an epoch whose loader ended before the length it claims."""
        stopped = trainer.should_stop or 0 <= trainer.max_steps <= trainer.global_step
        if self.progress.batch and not stopped:
            self.progress = replace(self.progress, epoch=self.progress.epoch + 1, batch=0)

    def on_save_checkpoint(
        self, trainer: pl.Trainer, pl_module: pl.LightningModule, checkpoint: dict[str, Any]
    ) -> None:
        """Add the generators' states and the progress."""
        fit_loop = checkpoint["loops"]["fit_loop"]
        self.progress.write(fit_loop, trainer.accumulate_grad_batches)
        states = generators.capture(trainer.strategy.root_device)
        fit_loop["state_dict"]["combined_loader"] = self._loader_states
        checkpoint[_KEY] = {
            "generators": generators.gather(states, trainer.world_size),
            "progress": self.progress.to_dict(),
            "loaders": self._loader_states,
        }

    def on_load_checkpoint(
        self, trainer: pl.Trainer, pl_module: pl.LightningModule, checkpoint: dict[str, Any]
    ) -> None:
        """Keep the states for when training starts. Raises UserError if the number of processes has changed."""
        if trainer.state.fn != TrainerFn.FITTING:
            return
        saved = checkpoint.get(_KEY)
        if saved is None:
            rank_zero_warn("the checkpoint holds no generator states: the run will go on, but not exactly as before")
            return
        ranks = len(saved["generators"])
        if ranks != trainer.world_size:
            raise UserError(
                f"resume: the checkpoint was written by {ranks} processes, this run has {trainer.world_size};"
                f" resume with {ranks} devices"
            )
        self._generators = saved["generators"][trainer.global_rank]
        self._loader_states = saved["loaders"]
        self.progress = Progress(**saved["progress"])
        self._resumed = True

    def on_train_start(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Put loops and data where they were. Raises UserError if the data has changed."""
        if not self._resumed:
            self._loader_states = [loader.state_dict() for loader in _resumable_loaders(trainer)]
            return
        self._resumed = False
        self.progress.start(trainer)
        batches = float(trainer.num_training_batches)
        if self.progress.batch and batches != self.progress.batches_per_epoch:
            raise UserError(
                f"resume: an epoch had {self.progress.batches_per_epoch:.0f} batches when the checkpoint was written,"
                f" has {batches:.0f} now; resume with the same data and batch size"
            )
        self._place_loaders(trainer)

    def on_train_batch_start(
        self, trainer: pl.Trainer, pl_module: pl.LightningModule, batch: Any, batch_idx: int
    ) -> None:
        """Restore the generators before the first batch: whatever came earlier may have drawn from them."""
        if self._generators is not None:
            generators.restore(self._generators, trainer.strategy.root_device)
            self._generators = None

    def _place_loaders(self, trainer: pl.Trainer) -> None:
        """Load the loaders' states anew.

        Lightning drops them where the optimiser's set-up asks for the number of steps, and between two epochs.
        """
        loaders, states = _resumable_loaders(trainer), self._loader_states
        if len(loaders) != len(states):
            raise UserError(f"resume: the checkpoint knows {len(states)} training loaders, this run has {len(loaders)}")
        for loader, state in zip(loaders, states, strict=True):
            loader.load_state_dict(state)
            assert loader.state_dict() == state, f"{type(loader).__name__} does not load what it saves"
        fetcher = trainer.fit_loop._data_fetcher
        assert fetcher is not None
        iter(fetcher)  # what was fetched ahead belongs to the old position


def _resumable_loaders(trainer: pl.Trainer) -> list[Any]:
    combined = trainer.fit_loop._combined_loader
    assert combined is not None
    return [
        loader for loader in combined.flattened if hasattr(loader, "state_dict") and hasattr(loader, "load_state_dict")
    ]
