"""Films of the policies that fine-tunings trained: what they do, and amid what."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from repdib_lightning.errors import UserError
from repdib_lightning.evaluation.figures import png
from repdib_lightning.experiments.page import Part
from repdib_lightning.experiments.points import Point
from repdib_lightning.experiments.results import Results
from repdib_lightning.rl.options import FILM

_SHOWN = 8


def film_parts(results: Results) -> list[Part]:
    """One part with the films of the settings that the suite names, of each one's first finished seed."""
    suite = results.suite
    named = [setting for grid in suite.grids for setting in grid.settings if setting.place in suite.films]
    wanted = {suite.run_by(setting).place for setting in named}
    films: dict[str, bytes] = {}
    strips: dict[str, np.ndarray] = {}
    for grid in suite.grids:
        for setting in grid.settings:
            point = next((p for seed in results.seeds if (p := results.point(setting, seed))), None)
            if point is None or setting.place not in wanted:
                continue
            for run, path in _films_of(point).items():
                name = f"film-{grid.name}-{setting.name}-{run}"
                films[name] = path.read_bytes()
                strips[f"{setting.place}, seed {point.seed}: {run}"] = frames_of(path, _SHOWN)
    if not films:
        return []
    sentence = (
        "The trained policies in evaluation episodes, as they see the environment; each film is of the first episodes "
        "of the first seed, good or bad. The strips show every film at even distances, from left to right."
    )
    return [Part("Films of the policies", [sentence], [], {"films": film_strips(strips)}, films)]


def _films_of(point: Point) -> dict[str, Path]:
    found = {name: point.finetune_folder(name) / FILM for name in point.finetune}
    return {name: path for name, path in found.items() if path.is_file()}


def frames_of(path: Path, count: int) -> np.ndarray:
    """(count, H, W, 3) uint8: frames of a film at even distances.

    Raises:
        UserError: it cannot be read.
    """
    import av

    try:
        with av.open(str(path)) as container:
            frames = [frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)]
    except (OSError, ValueError, IndexError) as error:
        raise UserError(f"{path}: not a readable film ({str(error).splitlines()[0]}); fine-tune again") from error
    return np.stack([frames[i] for i in np.linspace(0, len(frames) - 1, count).astype(int)])


def film_strips(strips: dict[str, np.ndarray]) -> bytes:
    """One line of frames (n, H, W, 3) a film."""
    height, width = next(iter(strips.values())).shape[1:3]
    size = (11.0, max(1.2, 11.0 / _SHOWN * height / width + 0.3) * len(strips))
    figure = Figure(figsize=size, layout="constrained")
    panels = figure.subplots(len(strips), 1, squeeze=False)[:, 0]
    for panel, (name, frames) in zip(panels, strips.items(), strict=True):
        panel.imshow(np.concatenate(list(frames), axis=1))
        panel.set_title(name, fontsize=8, loc="left")
        panel.set_axis_off()
    return png(figure)
