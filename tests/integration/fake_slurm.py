"""Imitates sbatch, srun, squeue and scontrol on this machine, as far as submitit and a suite use them.

``$FAKE_SLURM`` is its folder: ``queue/17_0`` for each job element that has not ended (its content says ``pending`` or
``running``), ``scripts/17`` for what was submitted, ``requeued`` for what was put back. While there is a file ``held``,
jobs stay pending. ``refuse`` makes sbatch and squeue complain of what it says.
"""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
import time
from pathlib import Path

PYTHON = sys.executable
COMMANDS = ("sbatch", "srun", "squeue", "scontrol")


def install(folder: Path) -> Path:
    """Make the folder; returns the one of the commands, for ``PATH``."""
    for name in ("bin", "queue", "scripts"):
        (folder / name).mkdir(parents=True)
    for name in COMMANDS:
        command = folder / "bin" / name
        start = f'FAKE_SLURM="{folder}" exec "{PYTHON}" -I -S "{__file__}" {name} "$@"'
        command.write_text(f"#!/bin/sh\n{start}\n")
        command.chmod(0o755)
    return folder / "bin"


def sbatch(folder: Path, words: list[str]) -> None:
    number = 17 + len(list((folder / "scripts").iterdir()))
    script = folder / "scripts" / str(number)
    shutil.copy(words[0], script)
    array = re.search(r"--array=0-(\d+)", script.read_text())
    elements = [f"{number}_{index}" for index in range(int(array[1]) + 1)] if array else [str(number)]
    for element in elements:
        (folder / "queue" / element).write_text("pending")
    if not (folder / "held").exists():
        release(folder, elements)
    print(f"Submitted batch job {number}")


def release(folder: Path, elements: list[str]) -> None:
    """Start elements in the background."""
    for element in elements:
        command = [PYTHON, "-I", "-S", __file__, "element", element]
        output = open(folder / "output.txt", "a")  # noqa: SIM115
        environment = {**os.environ, "FAKE_SLURM": str(folder)}
        subprocess.Popen(command, stdout=output, stderr=output, env=environment, start_new_session=True)


def element(folder: Path, words: list[str]) -> None:
    """Run one element until it ends without having been put back."""
    number, _, index = words[0].partition("_")
    place = {
        "SLURM_JOB_ID": str(100 + int(index)) if index else number,
        "SLURM_NTASKS": "1",
        "SLURM_JOB_NUM_NODES": "1",
    }
    if index:
        place |= {"SLURM_ARRAY_JOB_ID": number, "SLURM_ARRAY_TASK_ID": index}
    back = folder / f"requeue-{words[0]}"
    while True:
        while (folder / "held").exists():
            time.sleep(0.02)
        (folder / "queue" / words[0]).write_text("running")
        subprocess.run(["bash", folder / "scripts" / number], env={**os.environ, **place})
        if not back.exists():
            break
        back.unlink()
    (folder / "queue" / words[0]).unlink()


def srun(folder: Path, words: list[str]) -> None:
    while words[0].startswith("--"):
        del words[: 1 if words[0] == "--unbuffered" else 2]
    os.environ.update({"SLURM_PROCID": "0", "SLURM_LOCALID": "0", "SLURM_NODEID": "0"})
    os.execv(words[0], words)


def squeue(folder: Path, words: list[str]) -> None:
    assert words == ["--noheader", "--array", "--format=%i", f"--user={os.getuid()}"], words
    print(*sorted(path.name for path in (folder / "queue").iterdir()), sep="\n")


def scontrol(folder: Path, words: list[str]) -> None:
    assert words[0] == "requeue", words
    (folder / f"requeue-{words[1]}").touch()
    with open(folder / "requeued", "a") as file:
        file.write(f"{words[1]}\n")


if __name__ == "__main__":
    here = Path(os.environ["FAKE_SLURM"])
    refused = here / "refuse"
    if refused.exists() and sys.argv[1] in ("sbatch", "squeue"):
        sys.exit(f"{sys.argv[1]}: error: {refused.read_text()}")
    run = {"sbatch": sbatch, "srun": srun, "squeue": squeue, "scontrol": scontrol, "element": element}
    run[sys.argv[1]](here, sys.argv[2:])
