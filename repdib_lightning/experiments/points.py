"""One point of a suite: a setting and a seed, its folder, and the JSON line that tells what became of it."""

from __future__ import annotations

import fcntl
import json
import os
import time
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import IO, Any, Literal

from repdib_lightning.callbacks.status_file import read_status
from repdib_lightning.data.files import whole_file
from repdib_lightning.errors import UserError
from repdib_lightning.experiments.suite import SNAPSHOT, Setting, Suite

OUTCOME = "outcome.json"
"""What a fine-tuning writes last, in its folder."""

PROBE_FILE, SAMPLES_FILE = "probe.json", "probe.npz"
"""What probing writes, in the run's folder."""

State = Literal["waiting", "queued", "running", "stopped", "failed", "finished"]


@dataclass
class Record:
    """What is known of a point; written as one JSON line.

    Attributes:
        suite, grid, setting, seed: which point.
        arguments: of ``fit``, without the run's folder; a point keeps them for life.
        finetune: name of a fine-tuning -> arguments of ``finetune``, without encoder and folder; kept in the same way.
        seconds: phase -> wall seconds, over all attempts.
        error: one line, where the last attempt failed.
        job: of the cluster's queue, or empty.
        finished: whether every phase is done; only then are the following filled in.
        configuration: everything that the run used. versions: of the packages.
        data: file and fingerprint of what it was trained on; of an exploration its own replay.
        probed: the same of the store that it was probed on, where that is another one; else empty.
        threads: that each process had.
        factors: name -> ``state`` or ``noise``.
        metrics: measure -> number (see :mod:`repdib_lightning.experiments.measures`).
    """

    suite: str
    grid: str
    setting: str
    seed: int
    arguments: list[str]
    finetune: dict[str, list[str]] = field(default_factory=dict)
    seconds: dict[str, float] = field(default_factory=dict)
    error: str = ""
    job: str = ""
    finished: bool = False
    configuration: dict[str, Any] = field(default_factory=dict)
    versions: dict[str, str] = field(default_factory=dict)
    data: dict[str, str] = field(default_factory=dict)
    probed: dict[str, str] = field(default_factory=dict)
    threads: int = 0
    factors: dict[str, str] = field(default_factory=dict)
    metrics: dict[str, float] = field(default_factory=dict)

    def line(self) -> str:
        """The JSON line; without a word on fine-tunings, or on another store for probing, where there are none."""
        content = {name: value for name, value in asdict(self).items() if name not in ("finetune", "probed") or value}
        return json.dumps(content, allow_nan=False)


@dataclass(frozen=True)
class Point:
    """A setting with a seed.

    Attributes:
        suite, setting, seed: which one. folder: of its run; ``<folder>.json`` and ``<folder>.log`` lie beside it.
    """

    suite: Suite
    setting: Setting
    seed: int
    folder: Path

    @property
    def name(self) -> str:
        """``bottleneck/none seed 0``."""
        return f"{self.setting.place} seed {self.seed}"

    @property
    def log(self) -> Path:
        """What its commands printed."""
        return self.folder.with_name(self.folder.name + ".log")

    @property
    def file(self) -> Path:
        """Its record."""
        return self.folder.with_name(self.folder.name + ".json")

    @property
    def arguments(self) -> list[str]:
        """Of ``fit``, without the run's folder."""
        return self.setting.arguments(self.seed)

    @property
    def finetune(self) -> dict[str, list[str]]:
        """Name of each fine-tuning -> arguments of ``finetune``, without encoder and folder."""
        chosen = self.setting.finetune
        return {} if chosen is None else {name: chosen.arguments(name, self.seed) for name in chosen.runs}

    def finetune_folder(self, name: str) -> Path:
        """Of one fine-tuning."""
        return self.folder / "finetune" / name

    def encoder_of(self, name: str) -> Path | None:
        """What a fine-tuning is given: the exported bundle, the whole run for a snapshot of it, or nothing."""
        if not self.setting.pretrained or self.setting.finetune is None:
            return None
        return self.folder if SNAPSHOT in self.setting.finetune.runs[name] else self.folder / "bundle"

    def unfinished_finetunings(self) -> list[str]:
        """Names of those that have not written their outcome."""
        return [name for name in self.finetune if not (self.finetune_folder(name) / OUTCOME).is_file()]

    def record(self) -> Record:
        """Read what is known of this point. One that the suite has added a fine-tuning to is not finished any more.

        Raises:
            UserError: the file is damaged, or the folder holds a run with other options.
        """
        if not self.file.is_file():
            words = self.arguments
            return Record(self.suite.name, self.setting.grid, self.setting.name, self.seed, words, self.finetune)
        try:
            record = Record(**json.loads(self.file.read_text()))
        except (OSError, TypeError, ValueError) as error:
            raise UserError(f"{self.file}: not a suite's record ({error}); remove it and {self.folder}") from error
        if record.arguments != self.arguments:
            was, now = _first_difference(record.arguments, self.arguments)
            raise UserError(
                f"{self.folder}: was run with other options ({was or 'nothing'} then, {now or 'nothing'} now); remove "
                f"it and {self.file}, or give the suite's new settings another name"
            )
        record.finished = record.finished and set(self.finetune) <= set(record.finetune)
        record.finetune = self._checked_finetune(record)
        return record

    def _checked_finetune(self, record: Record) -> dict[str, list[str]]:
        """What the suite says now, where that is what has been run."""
        for name, words in self.finetune.items():
            before, folder = record.finetune.get(name, words), self.finetune_folder(name)
            if before == words:
                continue
            if folder.exists():
                was, now = _first_difference(before, words)
                raise UserError(
                    f"{folder}: was run with other options ({was or 'nothing'} then, {now or 'nothing'} now); remove "
                    "it, or give the suite's new fine-tuning another name"
                )
            record.finished = False
        return self.finetune

    def write(self, record: Record) -> None:
        """Write the record, whole."""
        with whole_file(self.file) as path:
            path.write_text(record.line() + "\n")

    def state(self) -> tuple[State, str]:
        """How it stands, and a word more: the phase, the step, or the error."""
        record = self.record()
        if record.finished:
            return "finished", ""
        run = read_status(self.folder) if self.folder.is_dir() else None
        step = f"step {run.step}" if run is not None and run.step else ""
        if self._is_locked():
            return "running", self._doing(run is not None and run.state == "finished", step)
        if record.error:
            return "failed", record.error
        if record.job:
            return "queued", f"job {record.job}"
        if self.setting.finetune is not None and self._is_probed():
            begun = run is not None or (self.folder / "finetune").is_dir()
            return ("stopped", self._doing(True, step)) if begun else ("waiting", "")
        return ("stopped", step) if run is not None else ("waiting", "")

    def _doing(self, trained: bool, step: str) -> str:
        """What comes next, or runs: the phase, and which step or fine-tuning of it."""
        if not self._is_probed():
            return "probe" if (self.folder / "bundle").is_dir() else "export" if trained else f"fit {step}".strip()
        names = self.unfinished_finetunings() or list(self.finetune)[-1:]
        return f"finetune {names[0]}" if names else "probe"

    def _is_probed(self) -> bool:
        return not self.setting.pretrained or (self.folder / PROBE_FILE).is_file()

    @contextmanager
    def lock(self) -> Iterator[int | None]:
        """Hold this point alone: yields a descriptor for child processes to inherit, or None if another has it.

        The kernel lets go of it when the last process that holds it ends, however it ends.
        """
        self.folder.parent.mkdir(parents=True, exist_ok=True)
        with open(self._lock_file, "w") as file:
            if not _take(file):
                yield None
                return
            os.set_inheritable(file.fileno(), True)
            yield file.fileno()

    @property
    def _lock_file(self) -> Path:
        return self.folder.with_name(f".{self.folder.name}.lock")

    def _is_locked(self) -> bool:
        if not self._lock_file.is_file():
            return False
        with open(self._lock_file) as file:
            try:
                fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)
            except BlockingIOError:
                return True
        return False


def points_of(suite: Suite, seeds: Iterable[int], root: Path, only: Iterable[str] = ()) -> list[Point]:
    """Every point of a suite once, all settings of a seed before the next seed; a grid may have fewer of the seeds.

    Args:
        suite: the suite. seeds: to use. root: folder of all suites' runs.
        only: places (``grid/setting``) of the settings to take; all by default.
    """
    wanted = set(only)
    chosen = [setting for setting in suite.settings if not wanted or setting.place in wanted]
    place = root / suite.name
    pairs = [(setting, seed) for seed in seeds for setting in chosen if suite.has(setting, seed)]
    return [Point(suite, setting, seed, place / setting.place / f"seed_{seed}") for setting, seed in pairs]


def _take(file: IO[str]) -> bool:
    """Take the lock. Tries for a moment, because :meth:`Point.state` of another process holds it for microseconds."""
    for pause in (0.001, 0.01, 0.05, 0.1, 0.0):
        with suppress(BlockingIOError):
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            return True
        time.sleep(pause)
    return False


def _first_difference(before: list[str], now: list[str]) -> tuple[str, str]:
    """The first word that differs on each side, after the option that it belongs to."""
    longest = max(len(before), len(now))
    padded = [words + [""] * (longest - len(words)) for words in (before, now)]
    place = next(i for i, (a, b) in enumerate(zip(*padded, strict=True)) if a != b)
    option = before[place - 1] if 0 < place <= len(before) and before[place - 1].startswith("--") else ""
    was, now_is = (f"{option} {words[place]}".strip() if words[place] else "" for words in padded)
    return was, now_is
