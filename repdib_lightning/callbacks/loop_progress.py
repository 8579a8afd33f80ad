"""Where training stands between two batches, written into Lightning's loop counters in the one form it resumes rightly.

Lightning's counters depend on the hook in which a checkpoint is taken, and some of those forms go wrong on resume
(after an epoch's last batch: hooks called twice or left out, epochs counted twice, a loader's state ignored). So the
counters in a checkpoint are rewritten: inside an epoch as they stand right after a batch, between epochs as though the
next one were about to begin.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

import lightning.pytorch as pl


@dataclass(frozen=True)
class Progress:
    """What has been trained on.

    Attributes:
        epoch: epochs completed; equally the number of the epoch that comes next or is under way.
        batch: batches trained on in that epoch; 0 between epochs.
        total_batches: batches trained on in the whole run.
        logged_steps: Lightning's count of steps for loggers, as it stands when the next batch begins.
        batches_per_epoch: of this data; infinite where the loader has no length.
    """

    epoch: int = 0
    batch: int = 0
    total_batches: int = 0
    logged_steps: int = 0
    batches_per_epoch: float = 0.0

    @classmethod
    def after_batch(cls, trainer: pl.Trainer) -> Progress:
        """Read the progress in ``on_train_batch_end``."""
        loop = trainer.fit_loop.epoch_loop
        stepped = 0 if loop._should_accumulate() else 1
        ended = trainer.is_last_batch
        return cls(
            epoch=trainer.current_epoch + int(ended),
            batch=0 if ended else loop.batch_progress.current.ready,
            total_batches=loop.batch_progress.total.ready,
            logged_steps=loop._batches_that_stepped + stepped,
            batches_per_epoch=float(trainer.num_training_batches),
        )

    def between_steps(self, trainer: pl.Trainer) -> bool:
        """Whether no gradients are half-accumulated."""
        return self.batch % trainer.accumulate_grad_batches == 0

    def to_dict(self) -> dict[str, Any]:
        """As primitives."""
        return asdict(self)

    def write(self, fit_loop: dict[str, Any], accumulated: int) -> None:
        """Write the progress over the ``fit_loop`` part of a checkpoint's loops.

        Args:
            fit_loop: changed in place.
            accumulated: batches whose gradients make one step.
        """
        within = int(self.batch > 0)
        fit_loop["epoch_progress"] = _counters(self.epoch, self.epoch, begun=within)
        batches = _counters(self.total_batches, self.batch, begun=0)
        for counter in batches.values():
            counter["completed"] -= within
        fit_loop["epoch_loop.batch_progress"] = {**batches, "is_last_batch": False}
        validation = fit_loop["epoch_loop.val_loop.batch_progress"]
        for name in ("total", "current"):
            validation[name] = dict.fromkeys(validation[name], validation[name]["completed"])
        # Lightning adds the step of the last batch itself where it resumes inside an epoch.
        stepped = int(within and self.batch % accumulated == 0)
        fit_loop["epoch_loop.state_dict"]["_batches_that_stepped"] = self.logged_steps - stepped

    def start(self, trainer: pl.Trainer) -> None:
        """Tell the restored loops, in ``on_train_start``, where they are.

        Lightning holds back epoch-wise plateau schedulers while it 'restarts', and takes any resumed run that is
        limited by steps for a restart inside an epoch.
        """
        fit_loop = trainer.fit_loop
        fit_loop._restarting = False
        if self.batch == 0:
            fit_loop.epoch_loop.restarting = False
            fit_loop.epoch_loop.reset_restart_stage()


def _counters(total: int, current: int, begun: int) -> dict[str, Any]:
    return {
        name: {"ready": count + begun, "started": count + begun, "processed": count, "completed": count}
        for name, count in (("total", total), ("current", current))
    }
