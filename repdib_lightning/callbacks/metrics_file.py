"""metrics.csv that a resumed run goes on with: Lightning's logger would delete it."""

from __future__ import annotations

import csv
from pathlib import Path

from lightning.pytorch.loggers import CSVLogger
from lightning.pytorch.loggers.csv_logs import ExperimentWriter
from lightning.pytorch.loggers.logger import rank_zero_experiment

from repdib_lightning.data.files import whole_file


class ContinuedCSVLogger(CSVLogger):
    """Lightning's CSVLogger, but what an earlier part of the run wrote stays.

    :class:`ExactResume` calls :meth:`continue_from`; :class:`RunCheckpoint` flushes the file before each checkpoint, so
    that it holds every step up to the one that a killed run is resumed from.
    """

    @property
    @rank_zero_experiment
    def experiment(self) -> _ContinuedWriter:
        """The writer of the file, opened at first use."""
        if self._experiment is None:
            self._fs.makedirs(self.root_dir, exist_ok=True)
            self._experiment = _ContinuedWriter(log_dir=self.log_dir)
        return self._experiment

    def continue_from(self, step: int) -> None:
        """Drop what was logged after ``step`` optimiser steps: those steps are about to be made again."""
        self.experiment.continue_from(step)


class _ContinuedWriter(ExperimentWriter):
    def __init__(self, log_dir: str) -> None:
        super().__init__(log_dir)
        self.metrics_keys = self._read()[0]

    def _check_log_dir_exists(self) -> None:
        """Lightning deletes the file here."""

    def continue_from(self, step: int) -> None:
        names, rows = self._read()
        if not names:
            return
        with whole_file(Path(self.metrics_file_path)) as path, open(path, "w", newline="") as file:
            writer = csv.DictWriter(file, fieldnames=names)
            writer.writeheader()
            writer.writerows(row for row in rows if int(row["step"]) < step)

    def _read(self) -> tuple[list[str], list[dict[str, str]]]:
        path = Path(self.metrics_file_path)
        if not path.is_file():
            return [], []
        with open(path, newline="") as file:
            reader = csv.DictReader(file)
            rows = [row for row in reader if None not in row.values()]  # a killed process may leave half a line
            return list(reader.fieldnames or []), rows
