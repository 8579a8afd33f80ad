"""Runs one point: fit, export, probe, finetune, each through the command line that a user would type."""

from __future__ import annotations

import math
import os
import shutil
import subprocess
import sys
import threading
import time
from collections.abc import Sequence
from typing import IO

from repdib_lightning.callbacks.status_file import read_status
from repdib_lightning.errors import UserError
from repdib_lightning.experiments.measures import collect_measures
from repdib_lightning.experiments.points import OUTCOME, PROBE_FILE, SAMPLES_FILE, Point, Record
from repdib_lightning.rl import RESUMABLE
from repdib_lightning.rl.options import CONFIGURATION

DEPENDENT = {
    "fit": ("fit", "export", "probe", "finetune"),
    "export": ("export", "probe", "finetune"),
    "probe": ("probe",),
    "finetune": ("finetune",),
}
"""Phase -> what is made of its result, itself included."""

_GRACE = 30.0


class Attempt:
    """One attempt at a point; goes on where an earlier one stopped, and leaves a record whatever happens.

    Args:
        point: which one.
        job: of the cluster's queue that makes the attempt, or empty.
    """

    def __init__(self, point: Point, job: str = "") -> None:
        self.point, self.job = point, job
        self._process: subprocess.Popen[bytes] | None = None
        self._stopped = threading.Event()

    def run(self) -> bool:
        """Go through the phases. Returns whether the point is finished (True also where it was already)."""
        with self.point.lock() as handle:
            if handle is None:
                return False
            record = self.point.record()
            if record.finished:
                return True
            self._remove_stillborn()
            record.error, record.job = "", self.job
            self.point.write(record)
            try:
                for phase in self.point.setting.phases:
                    self._phase(phase, record, handle)
                _complete(self.point, record)
            except UserError as error:
                record.error = "" if self._stopped.is_set() else str(error)
            if record.finished or not self._stopped.is_set():  # a job that was stopped is back in the queue
                record.job = ""
            self.point.write(record)
            return record.finished

    def terminate(self) -> None:
        """End the running command as a preemption would, so that it can go on later; start no other."""
        self._stopped.set()
        if self._process is not None:
            self._process.terminate()

    def kill_after(self, seconds: float) -> None:
        """Wait for the running command to end, and kill it when this takes too long."""
        if self._process is None:
            return
        try:
            self._process.wait(seconds)
        except subprocess.TimeoutExpired:
            self._process.kill()

    def _remove_stillborn(self) -> None:
        """Remove what a kill before the first checkpoint left: it cannot go on."""
        if self.point.setting.pretrained and not any(self.point.folder.glob("checkpoints/*.ckpt")):
            shutil.rmtree(self.point.folder, ignore_errors=True)

    def _phase(self, phase: str, record: Record, handle: int) -> None:
        if phase == "finetune":
            for name in self.point.unfinished_finetunings():
                self._timed(phase, self._finetune_options(name), record, handle, f" {name}")
        elif not self._is_done(phase):
            self._timed(phase, self._options(phase), record, handle)

    def _timed(self, phase: str, options: list[str], record: Record, handle: int, which: str = "") -> None:
        began = time.monotonic()
        try:
            code, last = self._command([phase, *options], handle)
        finally:
            record.seconds[phase] = round(record.seconds.get(phase, 0.0) + time.monotonic() - began, 1)
        if code != 0:
            raise UserError(f"{phase}{which} ended with exit code {code}: {last.removeprefix('error: ')}"[:500])
        self.point.write(record)

    def _is_done(self, phase: str) -> bool:
        run = self.point.folder
        if phase == "fit":
            status = read_status(run) if run.is_dir() else None
            return status is not None and status.state == "finished"
        return (run / {"export": "bundle/config.json", "probe": PROBE_FILE}[phase]).is_file()

    def _options(self, phase: str) -> list[str]:
        run = str(self.point.folder)
        if phase == "fit":
            begun = self.point.folder.is_dir()
            words = ["--resume", run] if begun else [*self.point.arguments, "--run", run]
            return [*words, "--trainer.enable_progress_bar", "false"]
        if phase == "export":
            return [run]
        asked = self.point.suite.probe_of(self.point.setting)
        chosen = [word for key, value in asked.items() for word in (f"--{key}", str(value))]
        kept = ["--output", f"{run}/{PROBE_FILE}", "--samples", f"{run}/{SAMPLES_FILE}"]
        return [run, str(self.point.setting.probed_on), *kept, *chosen]

    def _finetune_options(self, name: str) -> list[str]:
        given, folder = self.point.encoder_of(name), self.point.finetune_folder(name)
        encoder = [] if given is None else ["--encoder", str(given)]
        agent = self.point.finetune[name][0]
        resume = ["--resume", "true"] if agent in RESUMABLE and (folder / CONFIGURATION).is_file() else []
        if not resume:
            shutil.rmtree(folder, ignore_errors=True)  # what was ended, and cannot go on
        return [*self.point.finetune[name], *encoder, "--run", str(folder), *resume]

    def _command(self, words: list[str], handle: int) -> tuple[int, str]:
        """Run one command; its output goes to the point's log. Returns the exit code and the last line it printed."""
        if self._stopped.is_set():
            raise UserError("stopped")
        threads = str(self.point.suite.threads)
        environment = {**os.environ, "OMP_NUM_THREADS": threads, "MKL_NUM_THREADS": threads}
        command = [sys.executable, "-m", "repdib_lightning", *words]
        with open(self.point.log, "ab") as log:
            log.write(f"$ python -m repdib_lightning {' '.join(words)}\n".encode())
            log.flush()
            began = log.tell()
            # In a group of its own, so that Ctrl-C does not reach it: of SIGINT it would die, on SIGTERM it saves.
            self._process = subprocess.Popen(
                command,
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=log,
                env=environment,
                pass_fds=(handle,),
                process_group=0,
            )
            if self._stopped.is_set():  # asked for while the process started
                self._process.terminate()
            code = self._process.wait()
        with open(self.point.log, "rb") as log:
            return code, _last_line(log, began)


def _last_line(log: IO[bytes], began: int) -> str:
    log.seek(began)
    text = log.read().decode(errors="replace").replace("\r", "\n")
    lines = [line.strip() for line in text.splitlines() if line.strip()]
    return lines[-1] if lines else "(it printed nothing)"


def _complete(point: Point, record: Record) -> None:
    """Fill in the record of a point that went through every phase. Raises UserError if a measure is no number."""
    probe = point.folder / PROBE_FILE if point.setting.pretrained else None
    outcomes = {name: point.finetune_folder(name) / OUTCOME for name in point.finetune}
    facts = collect_measures(point.folder, probe, outcomes)
    for name, value in facts.metrics.items():
        if not math.isfinite(value):
            raise UserError(f"{name} is {value}")
    record.configuration, record.versions = facts.configuration, facts.versions
    record.data, record.probed = facts.data, facts.probed
    record.factors, record.metrics, record.threads = facts.factors, facts.metrics, point.suite.threads
    record.finished = True


def stop_all(attempts: Sequence[Attempt], grace: float = _GRACE) -> None:
    """Stop what these attempts run, all at once; what is left after ``grace`` seconds is killed."""
    for attempt in attempts:
        attempt.terminate()
    deadline = time.monotonic() + grace
    for attempt in attempts:
        attempt.kill_after(max(0.0, deadline - time.monotonic()))


def forget(point: Point, redo: str) -> None:
    """Make a phase that the point has, and what depends on it, undone; nothing where the point is running."""
    with point.lock() as handle:
        if handle is None:
            return
        record, redone = point.record(), DEPENDENT[redo]
        record.error, record.finished = "", False
        for phase in redone:
            record.seconds.pop(phase, None)
        point.write(record)
        if "fit" in redone:
            shutil.rmtree(point.folder, ignore_errors=True)
            point.log.unlink(missing_ok=True)
        if "export" in redone:
            shutil.rmtree(point.folder / "bundle", ignore_errors=True)
        if "probe" in redone:
            (point.folder / PROBE_FILE).unlink(missing_ok=True)
        if "finetune" in redone:
            for name in point.finetune:
                shutil.rmtree(point.finetune_folder(name), ignore_errors=True)
