"""Runs every benchmark in a process of its own and writes results/benchmarks.md.

python -m benchmarks                  all, on the CPU
python -m benchmarks start encoding   these again; the page keeps the others as they were
python -m benchmarks --device cuda    on a GPU, to results/benchmarks_cuda.md
"""

from __future__ import annotations

import argparse
import datetime
import os
import subprocess
import sys
from pathlib import Path

from repdib_lightning.data.files import whole_file

COMMANDS = {
    "quantiser": ["quantiser"],
    "quantiser_kept": ["quantiser", "--keep_memory"],
    "data_path": ["data_path"],
    "training_step": ["training_step"],
    "encoding": ["encoding"],
    "start": ["start"],
    "mazes": ["mazes"],
    "offline_agents": ["offline_agents"],
    "offline_run": ["offline_run"],
    "exploration": ["exploration"],
    "replay": ["replay"],
    "decision_transformer": ["decision_transformer"],
}
ON = {
    "cpu": [
        "quantiser",
        "quantiser_kept",
        "data_path",
        "training_step",
        "encoding",
        "start",
        "mazes",
        "offline_agents",
        "exploration",
        "replay",
        "decision_transformer",
    ],
    "cuda": ["quantiser", "data_path", "training_step", "encoding", "offline_run"],
}
ROOT = Path(__file__).parent.parent


def measured(name: str, device: str) -> str:
    """What one benchmark prints."""
    command = [sys.executable, "-m", f"benchmarks.{COMMANDS[name][0]}", *COMMANDS[name][1:]]
    command += ["--device", device] if device != "cpu" else []
    print(f"--- {' '.join(command[1:])}", flush=True)
    # As the command line of the package sets it, see its __main__.py.
    environment = {"GOMP_SPINCOUNT": "5000", **os.environ}
    done = subprocess.run(command, cwd=ROOT, env=environment, check=True, stdout=subprocess.PIPE, text=True)
    print(done.stdout, flush=True)
    return f"{done.stdout.strip()}\n\nMeasured on {datetime.date.today()} by `python {' '.join(command[1:])}`."


def main() -> None:
    """Run the named ones, or all, and put the page together."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="*", metavar="NAME", help=", ".join(COMMANDS))
    parser.add_argument("--device", default="cpu", choices=["cpu", "cuda"])
    options = parser.parse_args()
    device, offered = options.device, ON[options.device]
    for name in options.names:
        if name not in offered:
            parser.error(f"no benchmark '{name}' on {device}; there are {', '.join(offered)}")
    results = ROOT / "results"
    parts = results / ("benchmarks" if device == "cpu" else "benchmarks_cuda")
    for name in options.names or offered:
        text = measured(name, device)
        with whole_file(parts / f"{name}.md") as aside:
            aside.write_text(text + "\n")
    call = "make bench" if device == "cpu" else "make bench-gpu"
    head = (
        f"# Benchmarks\n\nMade by `{call}`. Ratios are the message: contenders took turns in one process, and the "
        "machine was shared. `met` and `MISSED` compare with what was asked for before anything was measured.\n"
    )
    texts = [(parts / f"{name}.md").read_text() for name in offered if (parts / f"{name}.md").is_file()]
    with whole_file(results / f"{parts.name}.md") as aside:
        aside.write_text("\n".join([head, *texts]))
    print(f"written: results/{parts.name}.md")


if __name__ == "__main__":
    main()
