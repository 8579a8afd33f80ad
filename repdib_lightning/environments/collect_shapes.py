"""Makes data sets of drawn shapes, all of whose factors are known, independent and uniform."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from repdib_lightning.data.schema import FactorSpec
from repdib_lightning.data.shapes import LEVELS, draw_shape
from repdib_lightning.data.writer import EpisodeWriter
from repdib_lightning.errors import UserError
from repdib_lightning.records import ArraySpec

VIEW = "pixels"
"""Name of the observation."""

_PICTURE_SIZES = (16, 512)


def collect_shapes(
    path: Path,
    *,
    samples: int = 10_000,
    size: int = 64,
    held_out: float = 0.2,
    seed: int = 0,
    overwrite: bool = False,
    progress: bool = True,
) -> Path:
    """Draw pictures of one shape each, from seven factors that are drawn independently and uniformly.

    Observation ``pixels``, (3, H, W) uint8; each picture is an episode of one row, without actions. Factors, all
    categorical and endogenous: shape (4), hue (8), size (4), horizontal (8), vertical (8), brightness (4) and
    background (8); see :data:`repdib_lightning.data.shapes.LEVELS`. Nothing else varies: there are 262,144 different
    pictures, so that of 2,000 held out of 10,000 about 3 % are also in training.

    Args:
        path: the file to make.
        samples: pictures.
        size: height and width in pixels, 16 to 512.
        held_out: share of the pictures, drawn at random, that is marked for evaluation; 0 marks none, and a reader then
            takes every fifth.
        seed: of the factors and of what is held out.
        overwrite: replace an existing file.
        progress: show a progress bar on a terminal.

    Returns:
        The path.

    Raises:
        UserError: an option out of range, a file that exists or cannot be written.
    """
    _check_options(samples, size, held_out, seed)
    random = np.random.default_rng(seed)
    drawn = random.integers([len(levels) for levels in LEVELS.values()], size=(samples, len(LEVELS)))
    evaluation = random.permutation(samples) < round(held_out * samples)
    writer = EpisodeWriter(
        path,
        rows=samples,
        episodes=samples,
        observations={VIEW: ArraySpec((3, size, size))},
        actions=None,
        factors={name: FactorSpec("endogenous", "categorical", len(levels)) for name, levels in LEVELS.items()},
        attributes={
            "environment": "shapes",
            "configuration": {"samples": samples, "size": size, "held_out": held_out, "seed": seed},
            "classes": {name: [str(level) for level in levels] for name, levels in LEVELS.items()},
            "seed": seed,
            "licence": "generated",
        },
        overwrite=overwrite,
    )
    from tqdm import tqdm

    with writer, tqdm(total=samples, unit=" samples", desc="shapes", disable=None if progress else True) as bar:
        for row, for_evaluation in zip(drawn, evaluation, strict=True):
            levels = dict(zip(LEVELS, map(int, row), strict=True))
            writer.add_episode(
                observations={VIEW: draw_shape(levels, size)[None]},
                factors={name: np.array([level]) for name, level in levels.items()},
                evaluation=bool(for_evaluation),
            )
            bar.update()
    return Path(path)


def _check_options(samples: int, size: int, held_out: float, seed: int) -> None:
    for name, value, least in (("samples", samples, 1), ("seed", seed, 0)):
        if value < least:
            raise UserError(f"{name}={value}: must be at least {least}")
    smallest, largest = _PICTURE_SIZES
    if not smallest <= size <= largest:
        raise UserError(f"size={size}: must be in {smallest} to {largest}")
    if not 0 <= held_out < 1 or round(held_out * samples) >= samples:
        raise UserError(f"held_out={held_out}: must be at least 0 and below 1, and leave one of {samples} for training")
