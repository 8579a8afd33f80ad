"""Shows what an exploration reaches while it runs, and keeps snapshots of it."""

from __future__ import annotations

import io
import sys
from typing import Any

import lightning.pytorch as pl
import numpy as np
from lightning.pytorch.callbacks import Callback
from PIL import Image

from repdib_lightning.bottlenecks import VectorQuantiser
from repdib_lightning.callbacks.pictures import tensorboards
from repdib_lightning.errors import UserError
from repdib_lightning.rl.exploration.data import VIEW, ExplorationDataModule
from repdib_lightning.rl.exploration.module import BrokenExploration, ExplorationModule
from repdib_lightning.rl.exploration.replay import Replay
from repdib_lightning.rl.exploration.snapshots import snapshot_folder, write_snapshot
from repdib_lightning.rl.exploration.state_cells import StateCells

_FILM_FRAMES = 100
_MILLISECONDS = 50


class ExplorationProgress(Callback):
    """Logs, whenever episodes have ended: ``explore/coverage`` (cells of the state space that any of them was in, see
    :class:`~repdib_lightning.rl.exploration.state_cells.StateCells`), ``explore/task_return`` (mean of the task's own
    return, which nobody is trained on), ``explore/frames``; and a film of the newest one after 1, 2, 4, 8, ... of them.
    """

    def __init__(self) -> None:
        self._cells: StateCells | None = None
        self._counted = 0

    def on_train_start(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """What a run that goes on had been through is told already."""
        self._counted = _data_of(trainer).train_dataloader().episodes

    def on_train_batch_end(
        self, trainer: pl.Trainer, pl_module: pl.LightningModule, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        """Look whether episodes have ended."""
        data = _data_of(trainer)
        replay = data.replay
        if replay is None or replay.episodes == self._counted:
            return
        first, self._counted = self._counted, replay.episodes
        self._visit(replay, first)
        assert self._cells is not None
        told = {"explore/coverage": float(self._cells.visited), "explore/frames": float(data.frames_done)}
        if returns := data.take_returns():
            told["explore/task_return"] = float(np.mean(returns))
        step = trainer.global_step - 1  # of the batch, as in all other rows: a run that goes on drops later ones
        for logger in trainer.loggers:
            logger.log_metrics(told, step)
            logger.save()  # the checkpoint that follows says that this is told
        if first.bit_length() != self._counted.bit_length():
            for writer in tensorboards(trainer):
                add_film(writer, "explore/episode", film_of(replay, self._counted - 1), step)

    def on_train_epoch_end(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """All updates are one epoch: stop after it, whatever ``trainer.max_epochs`` says."""
        if trainer.global_step >= len(_data_of(trainer).train_dataloader()):
            trainer.should_stop = True

    def _visit(self, replay: Replay, first: int) -> None:
        """Count the states of episodes that were not counted; all of them where a run goes on."""
        names = [name for name, spec in replay.plan.factors.items() if spec.kind == "endogenous"]
        if self._cells is None:
            first = 0
            self._cells = StateCells(sum(replay.plan.factors[name].width for name in names))
        for episode in range(first, replay.episodes):
            parts = [replay.gather(f"factors/{name}", episode) for name in names]
            self._cells.visit(np.concatenate([part.reshape(len(part), -1) for part in parts], axis=1))


class Snapshots(Callback):
    """Writes ``snapshots/frames-...`` into the run's folder after the frames that ``data.snapshots`` lists, and one
    more, ``frames-...`` of where it stood, if the run is stopped because its losses broke."""

    def __init__(self) -> None:
        self._looked_at = 0

    def on_load_checkpoint(
        self, trainer: pl.Trainer, pl_module: pl.LightningModule, checkpoint: dict[str, Any]
    ) -> None:
        """Put the data where they were: nobody else does where every update is done, but not yet the last actions."""
        for state in checkpoint.get("exact_resume", {}).get("loaders", []):
            _data_of(trainer).train_dataloader().load_state_dict(state)

    def on_train_start(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Refuse snapshots before the quantiser has started."""
        data = _data_of(trainer)
        self._looked_at = data.frames_done
        starts = [module.start_step for module in pl_module.modules() if isinstance(module, VectorQuantiser)]
        for frames in data.snapshots[:1]:
            updates = (frames // data.action_repeat - data.schedule.seed) // data.update_every
            if updates <= max(starts, default=-1):
                raise UserError(
                    f"data.snapshots: after {frames} frames there were {max(updates, 0)} updates, the quantiser starts "
                    f"after {max(starts)}; choose later snapshots, or an earlier start_step"
                )

    def on_train_batch_end(
        self, trainer: pl.Trainer, pl_module: pl.LightningModule, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        """Write the snapshots that are due."""
        data = _data_of(trainer)
        before, self._looked_at = self._looked_at, data.frames_done
        for frames in data.snapshots:
            if before < frames <= self._looked_at:
                self._write(trainer, pl_module, frames)

    def on_train_end(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Write the last one, which is due after the last update, once all are done."""
        data = _data_of(trainer)
        if trainer.global_step >= len(data.train_dataloader()):
            for frames in data.snapshots:
                if frames > data.frames_done:
                    self._write(trainer, pl_module, frames)

    def on_exception(self, trainer: pl.Trainer, pl_module: pl.LightningModule, exception: BaseException) -> None:
        """Keep what there was before the update that broke."""
        if isinstance(exception, BrokenExploration):
            try:
                folder = self._write(trainer, pl_module, _data_of(trainer).frames_done)
                print(f"snapshot of what there was before: {folder}", flush=True)
            except UserError as error:
                print(f"warning: no snapshot: {error}", file=sys.stderr)

    def _write(self, trainer: pl.Trainer, pl_module: pl.LightningModule, frames: int) -> Any:
        assert isinstance(pl_module, ExplorationModule)
        data = _data_of(trainer)
        assert data.folder is not None
        return write_snapshot(
            snapshot_folder(data.folder, frames),
            pl_module.encoder,
            pl_module.bottleneck,
            pl_module.agent,
            training={"objective": pl_module.objective.label, "run": data.folder.name, "frames": frames},
            data=data.facts,
            facts={
                "task": data.task,
                "frames": frames,
                "image_size": data.image_size,
                "action_repeat": data.action_repeat,
                **data.scene,
                "hidden": pl_module.hidden,
                "standardise": pl_module.standardise,
                "features": pl_module.encoder.features,
                "actions": data.actions,
            },
        )


def film_of(replay: Replay, episode: int) -> np.ndarray:
    """(T, H, W, 3) uint8: an episode, of long ones every so many frames."""
    rows = replay.plan.steps + 1
    chosen = np.arange(0, rows, -(-rows // _FILM_FRAMES))
    return replay.gather(f"observations/{VIEW}", episode, chosen).transpose(0, 2, 3, 1)


def add_film(writer: Any, name: str, frames: np.ndarray, step: int) -> None:
    """Show a film (T, H, W, 3) uint8 in TensorBoard, as an animated GIF among the pictures."""
    from tensorboard.compat.proto.summary_pb2 import Summary

    pictures = [Image.fromarray(frame) for frame in frames]
    content = io.BytesIO()
    pictures[0].save(content, "GIF", save_all=True, append_images=pictures[1:], duration=_MILLISECONDS, loop=0)
    height, width = frames.shape[1:3]
    image = Summary.Image(height=height, width=width, colorspace=3, encoded_image_string=content.getvalue())
    writer.file_writer.add_summary(Summary(value=[Summary.Value(tag=name, image=image)]), step)


def _data_of(trainer: pl.Trainer) -> ExplorationDataModule:
    data = trainer.datamodule  # type: ignore[attr-defined]
    assert isinstance(data, ExplorationDataModule)
    return data
