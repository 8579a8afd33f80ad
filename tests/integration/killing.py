"""Runs the command line in a process of its own, which may be killed; the imports are made once, in a fork server."""

from __future__ import annotations

import multiprocessing
import os
import signal
import sys
from pathlib import Path
from typing import Any

import lightning.pytorch as pl
from lightning.pytorch.callbacks import Callback


class KillAfter(Callback):
    """SIGKILL this process after a number of training batches.

    Args:
        batches: of the whole run.
    """

    def __init__(self, batches: int) -> None:
        self.batches = batches

    def on_train_batch_end(self, trainer: pl.Trainer, pl_module: pl.LightningModule, *_: Any) -> None:
        if trainer.global_step == self.batches:
            os.kill(os.getpid(), signal.SIGKILL)


def _child(folder: str, arguments: list[str]) -> None:
    os.chdir(folder)
    import torch

    from repdib_lightning.__main__ import main

    torch.set_num_threads(1)
    # Loader workers notice the death of the process that forked them; a fork server would outlive it, and they too.
    multiprocessing.set_start_method("fork", force=True)
    with open("output.txt", "a") as output:
        sys.stdout = sys.stderr = output
        sys.exit(main(arguments))


def command(folder: Path, *arguments: str) -> int:
    """Run ``python -m repdib_lightning ARGUMENTS`` in a folder; return its exit code (negative: killed)."""
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(["repdib_lightning.cli", "killing"])
    process = context.Process(target=_child, args=(str(folder), list(arguments)))
    process.start()
    process.join()
    assert process.exitcode is not None
    return process.exitcode
