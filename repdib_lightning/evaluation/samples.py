"""What figures of a probed encoder need, in one small file: some latents, their factors, and pictures drawn again."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from repdib_lightning.data.files import whole_file
from repdib_lightning.errors import UserError
from repdib_lightning.evaluation.decoder import Drawings

MOST = 1500


@dataclass(frozen=True)
class ProbeSamples:
    """Evenly spaced evaluation rows of a store.

    Attributes:
        rows: (n,) int64. latents: (n, M) float32. factors: name -> (n, ...) as stored.
        drawings: frames beside what the decoder drew of them; None where no decoder was fitted.
    """

    rows: np.ndarray
    latents: np.ndarray
    factors: dict[str, np.ndarray]
    drawings: Drawings | None

    def write(self, path: Path) -> None:
        """Write an .npz of plain arrays, whole. Raises UserError if it cannot be written."""
        arrays = {"rows": self.rows, "latents": self.latents}
        arrays |= {f"factors/{name}": values for name, values in self.factors.items()}
        if self.drawings is not None:
            arrays["drawn_rows"] = self.drawings.rows
            arrays |= {f"frames/{view}": pixels for view, pixels in self.drawings.frames.items()}
            arrays |= {f"drawn/{view}": pixels for view, pixels in self.drawings.drawn.items()}
        with whole_file(path) as aside, open(aside, "wb") as file:
            np.savez_compressed(file, allow_pickle=False, **arrays)


def read_samples(path: Path) -> ProbeSamples:
    """Read what :meth:`ProbeSamples.write` wrote. Raises UserError if it is not that."""
    try:
        with np.load(path, allow_pickle=False) as file:
            arrays = {name: file[name] for name in file.files}
        drawings = None
        if "drawn_rows" in arrays:
            drawings = Drawings(arrays["drawn_rows"], _under(arrays, "frames/"), _under(arrays, "drawn/"))
        return ProbeSamples(arrays["rows"], arrays["latents"], _under(arrays, "factors/"), drawings)
    except Exception as error:  # a damaged file makes zip, zlib and numpy raise a dozen unrelated kinds
        reason = (str(error) or type(error).__name__).splitlines()[0]
        raise UserError(f"{path}: not the samples of a probe ({reason}); run the probe again") from error


def _under(arrays: dict[str, np.ndarray], prefix: str) -> dict[str, np.ndarray]:
    return {name.removeprefix(prefix): array for name, array in arrays.items() if name.startswith(prefix)}
