"""How long until something happens? Wall time of new processes, each beside the bare import of torch.

No process is warm, but the files are in the page cache.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
from functools import partial
from pathlib import Path
from typing import Any

from lightning.pytorch.callbacks import Callback

from benchmarks import stores
from benchmarks.encoding import bundle
from benchmarks.measuring import alternate
from benchmarks.reporting import claim, machine, table
from repdib_lightning.data.episodes import EpisodeStore
from repdib_lightning.records import ActionSpec

LOAD = "from repdib_lightning.export import load_encoder; load_encoder({!r})"


class StopAfterFirstStep(Callback):
    """Ends the process at once when the first step is done."""

    def on_train_batch_end(self, *_: Any) -> None:
        """Leave without any cleaning up, whose time is not asked for."""
        os._exit(0)


def run(folder: Path, *arguments: str) -> None:
    """A new Python process."""
    here = Path(__file__).parent.parent
    environment = {**os.environ, "PYTHONPATH": str(here)}
    done = subprocess.run([sys.executable, *arguments], cwd=folder, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


def fit_one_step(folder: Path) -> None:
    """The default configuration up to its first training step, into a new run folder."""
    options = ["--data.path", "store.h5", "--run", str(Path(tempfile.mkdtemp(dir=folder)) / "run")]
    run(folder, "-m", "repdib_lightning", "fit", *options, "--trainer.callbacks", "benchmarks.start.StopAfterFirstStep")


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rounds", type=int, default=20)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        store = stores.write(folder / "store.h5", stores.ARM, ActionSpec("discrete", 5), rows=4000)
        bundle(folder / "bundle", EpisodeStore(store), 1, 128, [2, 2, 1, 1])
        contenders = {
            "python -c pass": partial(run, folder, "-c", "pass"),
            "--help": partial(run, folder, "-m", "repdib_lightning", "--help"),
            "import torch": partial(run, folder, "-c", "import torch"),
            "import lightning.pytorch": partial(run, folder, "-c", "import lightning.pytorch"),
            "load_encoder": partial(run, folder, "-c", LOAD.format("bundle")),
            "first training step of fit": partial(fit_one_step, folder),
        }
        took = alternate(contenders, options.rounds, warmup=1)
    print("## Start\n")
    print(f"{machine()}. Median wall time of {options.rounds} new processes each, in turn.\n")
    rows = [[what, took[what], took.ratio(what, "import torch")] for what in contenders]
    print(table(["what", "seconds", "imports of torch"], rows) + "\n")
    print(claim("--help, seconds", took["--help"], at_most=0.5))
    print(claim("load_encoder, imports of torch", took.ratio("load_encoder", "import torch"), at_most=1.5))


if __name__ == "__main__":
    main()
