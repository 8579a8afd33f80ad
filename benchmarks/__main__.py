"""Runs every benchmark in a process of its own and writes results/benchmarks.md.

python -m benchmarks                  on the CPU
python -m benchmarks --device cuda    on a GPU, to results/benchmarks_cuda.md
"""

from __future__ import annotations

import argparse
import datetime
import os
import subprocess
import sys
from pathlib import Path

from benchmarks.reporting import machine
from repdib_lightning.data.files import whole_file

CPU = ["quantiser", "quantiser --keep_memory", "data_path", "training_step", "encoding", "start"]
CUDA = ["quantiser", "data_path", "training_step", "encoding", "offline_run"]
ROOT = Path(__file__).parent.parent


def main() -> None:
    """Run all; a benchmark that fails ends everything, and the old page stays."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--device", default="cpu", choices=["cpu", "cuda"])
    device = parser.parse_args().device
    gpu = device == "cuda"
    # As the command line sets it, see __main__.py of the package.
    environment = {"GOMP_SPINCOUNT": "5000", **os.environ}
    parts = []
    for name in CUDA if gpu else CPU:
        command = [sys.executable, "-m", *f"benchmarks.{name}".split()]
        command += ["--device", device] if gpu else []
        print(f"--- {' '.join(command[1:])}", flush=True)
        done = subprocess.run(command, cwd=ROOT, env=environment, check=True, stdout=subprocess.PIPE, text=True)
        print(done.stdout, flush=True)
        parts.append(done.stdout.strip())
    call = "make bench-gpu" if gpu else "make bench"
    head = (
        f"# Benchmarks\n\nMade by `{call}` on {datetime.date.today()}: {machine(device)}.\n\n"
        "Ratios are the message: contenders took turns in one process, and the machine was shared. "
        "`met` and `MISSED` compare with what was asked for before anything was measured.\n"
    )
    page = ROOT / "results" / ("benchmarks_cuda.md" if gpu else "benchmarks.md")
    page.parent.mkdir(exist_ok=True)
    with whole_file(page) as aside:
        aside.write_text("\n\n".join([head.strip(), *parts]) + "\n")
    print(f"written: {page.relative_to(ROOT)}")


if __name__ == "__main__":
    main()
