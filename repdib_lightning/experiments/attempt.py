"""Runs one point: fit, export, probe, each through the command line that a user would type."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path
from typing import IO

from repdib_lightning.callbacks.status_file import read_status
from repdib_lightning.errors import UserError
from repdib_lightning.experiments.measures import collect_measures
from repdib_lightning.experiments.points import PHASES, Point, Record

PROBE_FILE, SAMPLES_FILE = "probe.json", "probe.npz"
_GRACE = 30.0


class Attempt:
    """One attempt at a point; goes on where an earlier one stopped, and leaves a record whatever happens.

    Args:
        point: which one.
        redo: the first phase to do anew although it was done, or empty.
    """

    def __init__(self, point: Point, redo: str = "") -> None:
        self.point, self.redo = point, redo
        self._process: subprocess.Popen[bytes] | None = None
        self._stopped = threading.Event()

    def run(self) -> bool:
        """Go through the phases. Returns whether the point is finished (True also where it was already)."""
        with self.point.lock() as handle:
            if handle is None:
                return False
            record = self.point.record()
            if record.finished and not self.redo:
                return True
            self._forget(record)
            self.point.write(record)
            try:
                for phase in PHASES:
                    self._phase(phase, record, handle)
                _complete(self.point, record)
            except UserError as error:
                record.error = "" if self._stopped.is_set() else str(error)
            record.job = ""
            self.point.write(record)
            return record.finished

    def stop(self) -> None:
        """End the running command as a preemption would, so that it can go on later."""
        self._stopped.set()
        process = self._process
        if process is None or process.poll() is not None:
            return
        process.send_signal(signal.SIGTERM)
        try:
            process.wait(_GRACE)
        except subprocess.TimeoutExpired:
            process.kill()

    def _forget(self, record: Record) -> None:
        """Remove what is to be done anew, and what a kill before the first checkpoint left."""
        run = self.point.folder
        redone = PHASES[PHASES.index(self.redo) :] if self.redo else ()
        unusable = run.is_dir() and not any(run.glob("checkpoints/*.ckpt"))
        if "fit" in redone or unusable:
            shutil.rmtree(run, ignore_errors=True)
            self.point.log.unlink(missing_ok=True)
        if "export" in redone:
            shutil.rmtree(run / "bundle", ignore_errors=True)
        if "probe" in redone:
            (run / PROBE_FILE).unlink(missing_ok=True)
        for phase in redone:
            record.seconds.pop(phase, None)
        record.error, record.finished = "", False

    def _phase(self, phase: str, record: Record, handle: int) -> None:
        if self._is_done(phase):
            return
        began = time.monotonic()
        try:
            code, last = self._command([phase, *self._options(phase)], handle)
        finally:
            record.seconds[phase] = round(record.seconds.get(phase, 0.0) + time.monotonic() - began, 1)
        if code != 0:
            raise UserError(f"{phase} ended with exit code {code}: {last.removeprefix('error: ')}"[:500])
        if not self._is_done(phase):
            raise UserError(f"{phase} stopped before its end: {last}"[:500])
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
        suite = self.point.suite
        chosen = [word for key, value in suite.probe.items() for word in (f"--{key}", str(value))]
        kept = ["--output", f"{run}/{PROBE_FILE}", "--samples", f"{run}/{SAMPLES_FILE}"]
        return [run, str(suite.data), *kept, *chosen]

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
            self._process = subprocess.Popen(
                command, stdin=subprocess.DEVNULL, stdout=log, stderr=log, env=environment, pass_fds=(handle,)
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
    """Fill in the record of a point that went through every phase."""
    facts = collect_measures(point.folder, point.folder / PROBE_FILE)
    record.configuration, record.versions, record.data = facts.configuration, facts.versions, facts.data
    record.factors, record.metrics, record.threads = facts.factors, facts.metrics, point.suite.threads
    record.finished = True


def run_point(point: Point, redo: str = "") -> bool:
    """One attempt, for executors that run it in a process of their own."""
    return Attempt(point, redo).run()


def log_tail(path: Path, lines: int = 5) -> str:
    """The last lines of a log, or an empty text."""
    if not path.is_file():
        return ""
    text = path.read_text(errors="replace").replace("\r", "\n")
    return "\n".join([line for line in text.splitlines() if line.strip()][-lines:])
