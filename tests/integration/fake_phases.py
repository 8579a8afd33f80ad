"""Imitates ``python -m repdib_lightning fit`` (or export, probe, finetune) in milliseconds.

Put into the place of ``sys.executable`` (:func:`install`). Each command appends ``begin PHASE POINT ...`` to calls.txt,
and ``end ...`` where it is fit. A file ``orders/PHASE-POINT`` (POINT is SETTING-seed_N) makes a command misbehave:

- ``fail``: one line on stderr, exit code 2;
- ``wait``: after the checkpoint, until the file is removed; SIGTERM ends it as it ends training;
- ``wait before checkpoint``: the same before there is one;
- ``die at the end``: SIGKILL after the last step's checkpoint, before the status says so;
- ``nan``: training logs a loss that is none.

For finetune, ``fail NAME`` and ``wait NAME`` are about one of a point's fine-tunings. A fit with ``--data.snapshots``
explores: small.h5 becomes its replay.
"""

from __future__ import annotations

import json
import os
import shutil
import signal
import socket
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import NoReturn

PYTHON = sys.executable


def install(folder: Path) -> str:
    """Write the executable; returns its path. Run otherwise than for a phase, it is Python, with itself in place."""
    script = folder / "fake_python"
    lines = [
        "#!/bin/sh",
        f'[ "$2" = repdib_lightning ] && exec "{PYTHON}" -I -S "{__file__}" "$@"',
        'code="import runpy, sys; sys.executable = sys.argv.pop(1); del sys.argv[1:3]; module = sys.argv[1]; '
        "del sys.argv[0]; runpy.run_module(module, run_name='__main__', alter_sys=True)\"",
        f'exec "{PYTHON}" -c "$code" "$0" "$@"',  # called by submitit, as: -u -m MODULE FOLDER
    ]
    script.write_text("\n".join(lines) + "\n")
    script.chmod(0o755)
    return str(script)


def calls(*beginning: str) -> list[list[str]]:
    """What the commands noted, in words, of the lines that begin so."""
    lines = [line.split() for line in Path("calls.txt").read_text().splitlines()]
    return [line for line in lines if line[: len(beginning)] == list(beginning)]


def wait_until(holds: Callable[[], object], what: str) -> None:
    for _ in range(1000):
        if holds():
            return
        time.sleep(0.02)
    raise AssertionError(f"not so: {what}; {calls()}")


def order(phase: str, run: Path) -> Path:
    return Path("orders") / f"{phase}-{run.parent.name}-{run.name}"


def ordered(phase: str, run: Path) -> str:
    path = order(phase, run)
    return path.read_text() if path.is_file() else ""


def note(*words: object) -> None:
    with open("calls.txt", "a") as file:
        file.write(" ".join(map(str, words)) + "\n")


def breaks() -> NoReturn:
    print("error: it broke", file=sys.stderr)
    sys.exit(2)


def write_status(run: Path, state: str) -> None:
    began = int(Path("/proc/self/stat").read_text().rpartition(")")[2].split()[19])
    now = time.time()
    content = {"state": state, "process": os.getpid(), "process_started": began, "host": socket.gethostname(),
               "job": "", "started": now, "updated": now, "step": 3}  # fmt: skip
    aside = run / ".status"
    aside.write_text(json.dumps(content))
    aside.rename(run / "status.json")


def fit(words: list[str]) -> None:
    resumed = "--resume" in words
    run = Path(words[words.index("--resume" if resumed else "--run") + 1])
    checkpoint = run / "checkpoints" / "step-00000003.ckpt"
    note("begin fit", f"{run.parent.name}-{run.name}", "resume" if resumed else "new", os.getpid())
    if ordered("fit", run) == "fail":
        breaks()
    assert run.is_dir() == resumed, f"{run} resumed: {resumed}"
    if resumed and checkpoint.read_text() == "last":  # as fit does where nothing is left: the status stays
        print(f"{run}: is at step 3 already")
        return
    (run / "checkpoints").mkdir(parents=True, exist_ok=True)
    write_status(run, "running")
    loss = "nan" if ordered("fit", run) == "nan" else 0.25 + int(run.name[-1])
    if not resumed:
        (run / "config.yaml").write_text(f"seed_everything: {run.name[5:]}\nwords: {len(words)}\n")
        facts = {"versions": {"python": "3"}, "data": {"file": "small.h5", "fingerprint": "f"}}
        (run / "environment.json").write_text(json.dumps(facts))
        (run / "metrics.csv").write_text(f"step,val/loss\n1,9.0\n3,{loss}\n")
        if "--data.snapshots" in words:
            explore(run, json.loads(words[words.index("--data.snapshots") + 1]))
    if ordered("fit", run) == "wait before checkpoint":
        wait(run)
    checkpoint.write_text(f"new {time.time_ns()}" if not resumed else checkpoint.read_text())
    if ordered("fit", run) == "wait":
        wait(run)
    if ordered("fit", run) == "die at the end":
        checkpoint.write_text("last")
        os.kill(os.getpid(), signal.SIGKILL)
    write_status(run, "finished")
    note("end fit", f"{run.parent.name}-{run.name}")


def explore(run: Path, snapshots: list[int]) -> None:
    with open(run / "config.yaml", "a") as file:
        file.write("data:\n  class_path: repdib_lightning.rl.exploration.data.ExplorationDataModule\n")
    facts = {"versions": {"python": "3"}, "data": {"file": "replay.h5", "fingerprint": ""}}
    (run / "environment.json").write_text(json.dumps(facts))
    rows = ["step,explore/coverage,explore/loss,val/loss", "1,40,,", "2,,0.5,", "3,60,,0.25"]
    (run / "metrics.csv").write_text("\n".join(rows) + "\n")
    shutil.copy("small.h5", run / "replay.h5")
    for frames in snapshots:
        (run / "snapshots" / f"frames-{frames:09d}").mkdir(parents=True)


def wait(run: Path, phase: str = "fit") -> None:
    def leave(number: int, _: object) -> None:
        note("signal", f"{run.parent.name}-{run.name}", number)
        if phase == "fit":
            write_status(run, "preempted" if number == signal.SIGTERM else "interrupted")
        sys.exit(128 + number)

    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, leave)
    note("waits", f"{run.parent.name}-{run.name}", os.getpid())
    for _ in range(3000):  # not for ever, where a test has failed
        if not order(phase, run).exists():
            return
        time.sleep(0.01)


def export(words: list[str]) -> None:
    run = Path(words[0])
    note("begin export", f"{run.parent.name}-{run.name}")
    (run / "bundle").mkdir()  # as export does, it does not replace one
    (run / "bundle" / "config.json").write_text((run / "checkpoints" / "step-00000003.ckpt").read_text())


def probe(words: list[str]) -> None:
    run, output = Path(words[0]), Path(words[words.index("--output") + 1])
    note("begin probe", f"{run.parent.name}-{run.name}")
    if ordered("probe", run) == "fail":
        breaks()
    kept = 0.5 + int(run.name[-1]) / 10
    score = {"linear": {"kept": kept, "score": kept}}
    report = {"factors": {"cell": {"kind": "endogenous", "probes": score}}, "codebook": None, "pictures": None,
              "data": Path(words[1]).name, "fingerprint": "probed",
              "summary": {"endogenous": {"linear": kept}, "exogenous": {"linear": None}}}  # fmt: skip
    output.write_text(json.dumps(report))


def finetune(words: list[str]) -> None:
    given = dict(zip(words[1::2], words[2::2], strict=True))
    folder, environment = Path(given["--run"]), given["--env" if "--env" in given else "--task"]
    run, name = folder.parent.parent, folder.name
    encoder, snapshot = given.get("--encoder", ""), given.get("--snapshot", "")
    if snapshot:
        assert Path(encoder, "snapshots", f"frames-{int(snapshot):09d}").is_dir(), encoder
    else:
        assert not encoder or Path(encoder, "config.json").is_file(), encoder
    note("begin finetune", f"{run.parent.name}-{run.name}", name, encoder or "scratch")
    folder.mkdir(parents=True)  # as finetune does, it does not go on with one that was ended
    (folder / "progress.csv").write_text("step,eval/success\n100,0.0\n200,1.0\n")
    told = ordered("finetune", run)
    if told == f"fail {name}":
        breaks()
    if told == f"wait {name}":
        wait(run, "finetune")
    measures = {"success": 0.5 + int(given["--seed"]) / 10, "steps_to_solve": None}
    if words[0] == "ddpg":
        measures = {"return": int(snapshot or 0) / 10 + int(given["--seed"]), "mean_return": 1.0}
    outcome = {"agent": words[0], "environment": environment, "versions": {"python": "3"}, "configuration": given,
               "measures": measures, "maps": {}}  # fmt: skip
    (folder / "outcome.json").write_text(json.dumps(outcome))


if __name__ == "__main__":
    verb, *rest = sys.argv[3:]
    {"fit": fit, "export": export, "probe": probe, "finetune": finetune}[verb](rest)
