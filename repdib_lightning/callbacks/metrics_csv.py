"""metrics.csv of a run, kept whole when the run goes on."""

from __future__ import annotations

import csv
from pathlib import Path

from lightning.pytorch.loggers import CSVLogger
from lightning.pytorch.loggers.csv_logs import ExperimentWriter
from lightning.pytorch.utilities.rank_zero import rank_zero_only

from repdib_lightning.data.files import whole_file


class MetricsCSV(CSVLogger):
    """Lightning's CSV logger, which deletes the earlier part of a resumed run's metrics; this one keeps it.

    Args:
        folder: of the run; the file is ``metrics.csv`` in it.
        resumed_step: optimiser steps done when the run goes on; rows of later steps are dropped, they come again.
            None for a new run.
    """

    def __init__(self, folder: Path, resumed_step: int | None = None) -> None:
        super().__init__(str(folder.parent), name=folder.name, version="")
        self.file = folder / ExperimentWriter.NAME_METRICS_FILE
        self.resumed_step = resumed_step

    @property
    def experiment(self) -> ExperimentWriter:
        """The writer; made on first use, on the process that logs."""
        if self._experiment is None and rank_zero_only.rank == 0:  # type: ignore[attr-defined]
            fields, rows = ([], []) if self.resumed_step is None else self._kept(self.resumed_step)
            if rows:
                _write_table(self.file, fields, rows)
            else:
                self.file.unlink(missing_ok=True)
            self._experiment = _KeepingWriter(log_dir=self.log_dir)
            self._experiment.metrics_keys = fields if rows else []
        return super().experiment

    def _kept(self, step: int) -> tuple[list[str], list[dict[str, str]]]:
        if not self.file.is_file():
            return [], []
        with open(self.file, newline="") as file:
            table = csv.DictReader(file)
            complete = [row for row in table if None not in row.values() and row["step"].isdigit()]
            return list(table.fieldnames or []), [row for row in complete if int(row["step"]) < step]


class _KeepingWriter(ExperimentWriter):
    """Lightning's writer, where a kill at no moment loses what was written before."""

    def _check_log_dir_exists(self) -> None:
        """Lightning would delete the file here."""

    def _rewrite_with_new_header(self, fieldnames: list[str]) -> None:
        """Lightning would empty the file and write it again."""
        path = Path(self.metrics_file_path)
        with open(path, newline="") as file:
            rows = list(csv.DictReader(file))
        _write_table(path, fieldnames, rows)


def _write_table(path: Path, fields: list[str], rows: list[dict[str, str]]) -> None:
    with whole_file(path) as temporary, open(temporary, "w", newline="") as file:
        table = csv.DictWriter(file, fields)
        table.writeheader()
        table.writerows(rows)
