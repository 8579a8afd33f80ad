"""A toy run for the resume tests: everything in it that draws or keeps state does so in a different place."""

from __future__ import annotations

import json
import multiprocessing
import os
import random
import signal
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import lightning.pytorch as pl
import numpy as np
import torch
from lightning.pytorch.callbacks import Callback
from torch import Tensor, nn
from torch.utils.data import DataLoader, TensorDataset

from repdib_lightning.callbacks import exit_codes, last_good, run_callbacks, run_plugins
from repdib_lightning.callbacks.checkpoint_files import DigestingFile, step_of
from repdib_lightning.callbacks.metrics_csv import MetricsCSV
from repdib_lightning.errors import UserError

EPOCH = 5
SIGNALS = {"kill": signal.SIGKILL, "term": signal.SIGTERM, "interrupt": signal.SIGINT}


class ToyLoader:
    """Starts its workers at once, unlike a generator: what it fetched ahead is wrong if the position moves later."""

    def __init__(self, workers: int, draws: bool) -> None:
        rows = torch.arange(EPOCH * 4, dtype=torch.float32)
        self.dataset, self.workers = TensorDataset(torch.stack([rows.sin(), rows.cos()], 1)), workers
        self.draws = draws
        self.epoch = self.batch = 0

    def __len__(self) -> int:
        return EPOCH

    def __iter__(self) -> Iterator[Any]:
        if self.batch == EPOCH:
            self.epoch, self.batch = self.epoch + 1, 0
        order = torch.randperm(EPOCH * 4, generator=torch.Generator().manual_seed(self.epoch)).view(EPOCH, 4)
        generator = None if self.draws else torch.Generator()
        left = order[self.batch :].tolist()
        opened = DataLoader(self.dataset, batch_sampler=left, num_workers=self.workers, generator=generator)
        return self._counted(iter(opened))

    def _counted(self, batches: Iterator[Any]) -> Iterator[Any]:
        for batch in batches:
            self.batch += 1
            yield batch

    def state_dict(self) -> dict[str, int]:
        return {"epoch": self.epoch, "batch": self.batch}

    def load_state_dict(self, state: dict[str, int]) -> None:
        self.epoch, self.batch = state["epoch"], state["batch"]


class ToyModule(pl.LightningModule):
    """Dropout, augmentation, Python's and numpy's generators, running statistics, a target that lags behind."""

    def __init__(self, options: dict[str, Any]) -> None:
        super().__init__()
        self.options, self.record = options, Path(options["record"])
        self.net = nn.Sequential(nn.Linear(2, 8), nn.BatchNorm1d(8), nn.ReLU(), nn.Dropout(0.5), nn.Linear(8, 1))
        self.register_buffer("target", torch.zeros(8))

    def training_step(self, batch: list[Tensor], batch_idx: int) -> dict[str, Any]:
        x = batch[0] + 0.1 * torch.randn_like(batch[0]) + 0.01 * random.random() + 0.01 * np.random.normal()  # noqa: NPY002
        terms = {
            "fit": (self.net(x) - x[:, :1]).square().mean(),
            "pull": (self.net[0].bias - self.target).square().mean(),
        }
        if self.global_step + 1 == self.options.get("break_at"):
            terms["pull"] = _broken(terms["pull"], self.options["break_by"])
        loss = terms["fit"] + terms["pull"]
        self._note("train", self.total_batches, loss)
        self.log("loss", loss)
        return {"loss": loss, "terms": {name: term.detach() for name, term in terms.items()}}

    @property
    def total_batches(self) -> int:
        return self.trainer.fit_loop.total_batch_idx

    def on_train_batch_end(self, *_: Any) -> None:
        self.target.lerp_(self.net[0].bias.detach() + 0.01 * torch.randn(8), 0.1)

    def on_train_epoch_start(self) -> None:
        self._note("epoch", self.total_batches, torch.tensor(float(self.current_epoch)))

    def on_train_epoch_end(self) -> None:
        self._note("epoch_end", self.total_batches, torch.tensor(float(self.current_epoch)))

    def validation_step(self, batch: list[Tensor], batch_idx: int) -> None:
        loss = (self.net(batch[0]) - torch.rand(1)).square().mean()
        self.log("val_loss", loss)
        if not self.trainer.sanity_checking:
            self._note("val", 100 * self.total_batches + batch_idx, loss)

    def configure_optimizers(self) -> Any:
        optimizer = torch.optim.Adam(self.parameters(), lr=0.01)
        kind = self.options.get("schedule", "onecycle")
        if kind == "plateau":
            scheduler: Any = torch.optim.lr_scheduler.ReduceLROnPlateau(optimizer, patience=0, threshold=10.0)
            return {"optimizer": optimizer, "lr_scheduler": {"scheduler": scheduler, "monitor": "val_loss"}}
        steps = int(self.trainer.estimated_stepping_batches)
        scheduler = torch.optim.lr_scheduler.OneCycleLR(optimizer, max_lr=0.02, total_steps=steps)
        return {"optimizer": optimizer, "lr_scheduler": {"scheduler": scheduler, "interval": "step"}}

    def on_train_start(self) -> None:
        if self.trainer.world_size > 1 and not self.options.get("resume"):
            torch.manual_seed(self.global_rank)

    def _note(self, what: str, number: int, value: Tensor) -> None:
        with self.record.with_suffix(f".{self.global_rank}").open("a") as file:
            file.write(f"{what} {number} {float(value).hex()}\n")


def _broken(term: Tensor, how: str) -> Tensor:
    """A term that is not finite, or is but has a gradient that is not."""
    return (term * 0).sqrt() if how == "gradient" else term * float(how)


class Stop(Callback):
    """Ends the process in the chosen way after the chosen batch."""

    def __init__(self, batch: int, how: str) -> None:
        self.batch, self.how = batch, how

    def on_train_batch_end(self, trainer: pl.Trainer, *_: Any) -> None:
        if trainer.fit_loop.total_batch_idx + 1 == self.batch and self.how in SIGNALS:
            os.kill(os.getpid(), SIGNALS[self.how])

    def on_validation_end(self, trainer: pl.Trainer, *_: Any) -> None:
        if self.how == "kill_in_validation" and trainer.fit_loop.total_batch_idx + 1 == self.batch:
            os.kill(os.getpid(), signal.SIGKILL)


def kill_in_save(number: int) -> None:
    """Let the process die in the middle of its n-th save."""
    real, saves = DigestingFile.write, [0, 0]

    def write(self: DigestingFile, data: bytes) -> int:
        if not getattr(self, "seen", False):
            self.seen = True  # type: ignore[attr-defined]
            saves[0] += 1
        if saves[0] == number:
            saves[1] += 1
            if saves[1] > 20:
                self._handle.flush()
                os.kill(os.getpid(), signal.SIGKILL)
        return real(self, data)

    DigestingFile.write = write  # type: ignore[method-assign]


def train(folder: str, options: dict[str, Any]) -> None:
    """Run or resume (``options["resume"]``) the toy in a run folder, until it ends or is ended."""
    signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell's background job ignores it
    torch.set_num_threads(1)
    multiprocessing.set_start_method("fork", force=True)
    run = Path(folder)
    run.mkdir(exist_ok=True)
    sys.stdout = sys.stderr = (run / "stderr.txt").open("a")
    pl.seed_everything(8 if options.get("resume") else 7, verbose=False)
    if options.get("save_killed"):
        kill_in_save(options["save_killed"])
    module = ToyModule({"record": str(run / "record"), **options})
    validation = DataLoader(TensorDataset(torch.linspace(0, 1, 8).view(4, 2)), batch_size=2)
    loader = ToyLoader(options.get("workers", 0), options.get("draws", False))
    try:
        path = last_good(run) if options.get("resume") else None
        with exit_codes():
            trainer_of(run, path, options).fit(
                module, loader, validation if options.get("validate", True) else None, ckpt_path=path
            )
    except UserError as error:
        (run / "error.txt").write_text(str(error))
        raise SystemExit(2) from error
    weights = {name: value.double().flatten().tolist() for name, value in module.state_dict().items()}
    (run / "weights.json").write_text(json.dumps(weights))


def trainer_of(run: Path, path: Path | None, options: dict[str, Any]) -> pl.Trainer:
    """A Trainer with everything that makes a run safe."""
    callbacks = run_callbacks(run, options.get("every", 2))
    if options.get("stop"):
        callbacks.append(Stop(options["stop"], options.get("how", "kill")))
    return pl.Trainer(
        default_root_dir=str(run),
        accelerator="cpu",
        callbacks=callbacks,
        plugins=run_plugins(),
        logger=MetricsCSV(run, None if path is None else step_of(path)) if options.get("csv") else False,
        log_every_n_steps=1,
        enable_progress_bar=False,
        enable_model_summary=False,
        accumulate_grad_batches=options.get("accumulate", 1),
        num_sanity_val_steps=1,
        **options["trainer"],
    )
