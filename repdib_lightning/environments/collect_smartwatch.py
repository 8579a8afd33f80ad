"""Shoulder exercises seen by a smartwatch, from the installed package seglearn: ``collect smartwatch PATH``."""

from __future__ import annotations

from importlib.util import find_spec
from pathlib import Path

from repdib_lightning.data.importers.smartwatch import import_smartwatch
from repdib_lightning.errors import UserError

_FILE = Path("data", "watch_dataset.npy")


def collect_smartwatch(
    path: Path,
    *,
    window: float = 4.0,
    hop: float = 2.0,
    overwrite: bool = False,
    progress: bool = True,
) -> Path:
    """Make a store of the smartwatch recordings that come with seglearn; an episode is a window, of one row.

    Observations ``acceleration`` and ``gyroscope``, (T, 3) float32 at 50 Hz; factors activity, subject and side, see
    :func:`repdib_lightning.data.importers.smartwatch.import_smartwatch`. The windows of subjects 9 and 10 are marked
    for evaluation.

    Args:
        path: the store to write (.h5).
        window: length of a window in seconds.
        hop: seconds from the beginning of a window to that of the next.
        overwrite: replace an existing store.
        progress: show a progress bar on a terminal.

    Returns:
        The path.

    Raises:
        UserError: seglearn is not installed, or holds another file; a window or hop that is no whole number of
            readings.
    """
    return import_smartwatch(_installed(), path, window=window, hop=hop, overwrite=overwrite, progress=progress)


def _installed() -> Path:
    """The file inside the package, which is not imported."""
    spec = find_spec("seglearn")
    folders = [] if spec is None else [Path(place) for place in spec.submodule_search_locations or []]
    for folder in folders:
        if (folder / _FILE).is_file():
            return folder / _FILE
    what = f"{folders[0]}: has no {_FILE}" if folders else "the recordings come with seglearn, which is not installed"
    raise UserError(f"{what}; run: pip install 'repdib_lightning[activities]'")
