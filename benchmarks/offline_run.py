"""How long do 100,000 steps of the paper's offline setting take on a GPU?

``fit`` with the data resident on the device and bfloat16 arithmetic, from the command to the last checkpoint.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from contextlib import redirect_stdout
from pathlib import Path

from benchmarks import stores
from benchmarks.reporting import claim, machine, table
from repdib_lightning import __main__ as command_line
from repdib_lightning.records import ActionSpec

CONFIGURATION = Path(__file__).parent / "offline.yaml"


def main() -> None:
    """Print the time."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--device", default="cuda", choices=["cpu", "cuda"])
    parser.add_argument("--steps", type=int, default=100_000)
    parser.add_argument("--rows", type=int, default=100_000)
    parser.add_argument("--precision", default="bf16-mixed")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "store.h5"
        stores.write(path, stores.OFFLINE, ActionSpec("continuous", 6), rows=options.rows)
        arguments = ["fit", "--config", str(CONFIGURATION), "--data.path", str(path), "--data.resident", "true"]
        arguments += ["--run", str(Path(folder) / "run"), "--trainer.max_steps", str(options.steps)]
        arguments += ["--trainer.accelerator", "cpu" if options.device == "cpu" else "gpu", "--trainer.devices", "1"]
        arguments += ["--trainer.precision", options.precision, "--checkpoint_every", "10000"]
        arguments += ["--trainer.val_check_interval", str(min(options.steps, 10_000))]
        start = time.perf_counter()
        with redirect_stdout(sys.stderr):
            code = command_line.run(arguments)
        minutes = (time.perf_counter() - start) / 60
    assert code == 0, f"fit ended with {code}"
    print("## The offline setting, from the command to the end\n")
    print(f"{machine(options.device)}. {options.rows} rows of 84 px, 3 frames, B 256, M 256, {options.precision}.\n")
    print(table(["steps", "minutes", "steps/s"], [[options.steps, minutes, options.steps / minutes / 60]]) + "\n")
    print(claim("minutes for 100,000 steps", minutes * 100_000 / options.steps, at_most=5.0))


if __name__ == "__main__":
    main()
