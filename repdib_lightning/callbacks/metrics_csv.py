"""metrics.csv of a run, kept whole when the run goes on."""

from __future__ import annotations

import csv
from pathlib import Path

from lightning.pytorch.loggers import CSVLogger
from lightning.pytorch.loggers.csv_logs import ExperimentWriter
from lightning.pytorch.utilities.rank_zero import rank_zero_only


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
        if self._experiment is None and self.resumed_step is not None and rank_zero_only.rank == 0:  # type: ignore[attr-defined]
            fields, rows = self._kept(self.resumed_step)
            writer = super().experiment
            if rows:
                with open(self.file, "w", newline="") as file:
                    table = csv.DictWriter(file, fields)
                    table.writeheader()
                    table.writerows(rows)
                writer.metrics_keys = fields
        return super().experiment

    def _kept(self, step: int) -> tuple[list[str], list[dict[str, str]]]:
        if not self.file.is_file():
            return [], []
        with open(self.file, newline="") as file:
            table = csv.DictReader(file)
            complete = [row for row in table if None not in row.values() and row["step"].isdigit()]
            return list(table.fieldnames or []), [row for row in complete if int(row["step"]) < step]
