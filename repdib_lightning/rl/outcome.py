"""What a fine-tuning leaves last in its folder: ``outcome.json``, and a film."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from repdib_lightning.data.files import whole_file
from repdib_lightning.errors import UserError
from repdib_lightning.rl.film import side_by_side, write_film
from repdib_lightning.rl.options import FILM, OUTCOME


def write_outcome(folder: Path, outcome: Mapping[str, Any], films: Sequence[np.ndarray] = ()) -> None:
    """Write the film, then what was reached, which tells that the run is finished: one that is killed before goes on.

    Where the film cannot be written, what was reached is nevertheless.

    Args:
        folder: of the run. outcome: plain values. films: (T, H, W, 3) uint8 of each episode; none for no film.

    Raises:
        UserError: one of them cannot be written.
    """
    try:
        if films:
            write_film(folder / FILM, side_by_side(films))
    except UserError:
        _write(folder, outcome)
        raise
    _write(folder, outcome)


def _write(folder: Path, outcome: Mapping[str, Any]) -> None:
    with whole_file(folder / OUTCOME) as path:
        path.write_text(json.dumps(outcome, indent=1, allow_nan=False) + "\n")
