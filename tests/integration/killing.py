"""Runs the command line in a process of its own, which may be killed; the imports are made once, in a fork server."""

from __future__ import annotations

import multiprocessing
import os
import signal
import socket
import sys
from collections.abc import Sequence
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


def _child(folder: str, arguments: list[str], environment: dict[str, str]) -> None:
    signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell's background job ignores it
    os.chdir(folder)
    os.environ.update(environment)
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
    return _join([start(folder, arguments, {})])[0]


def command_in_processes(count: int, folder: Path, *arguments: str) -> list[int]:
    """The same in several processes that train together, with the environment that torchrun gives them."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    shared = {"MASTER_ADDR": "127.0.0.1", "MASTER_PORT": str(port), "TORCHELASTIC_RUN_ID": "test"}
    sizes = {"WORLD_SIZE": str(count), "LOCAL_WORLD_SIZE": str(count), "GROUP_RANK": "0"}
    ranks = [{"RANK": str(rank), "LOCAL_RANK": str(rank)} for rank in range(count)]
    return _join([start(folder, arguments, {**shared, **sizes, **rank}) for rank in ranks])


def start(folder: Path, arguments: Sequence[str], environment: dict[str, str]) -> Any:
    """The same without waiting: the process."""
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(["repdib_lightning.cli", "killing"])
    process = context.Process(target=_child, args=(str(folder), list(arguments), environment))
    process.start()
    return process


def _join(processes: Sequence[Any]) -> list[int]:
    for process in processes:
        process.join()
    return [process.exitcode for process in processes]
