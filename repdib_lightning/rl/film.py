"""Writes films of policies: episodes side by side, as MP4."""

from __future__ import annotations

from collections.abc import Sequence
from fractions import Fraction
from pathlib import Path

import numpy as np

from repdib_lightning.data.files import whole_file

_LEAST_HEIGHT = 128
_GAP = 4


def side_by_side(films: Sequence[np.ndarray]) -> np.ndarray:
    """(T, H, W, 3) uint8 of several films (T_i, H, W_i, 3); where one has ended its last frame stays."""
    longest = max(map(len, films))
    padded = [np.concatenate([film, np.repeat(film[-1:], longest - len(film), axis=0)]) for film in films]
    gap = np.full((longest, padded[0].shape[1], _GAP, 3), 255, np.uint8)
    parts = [part for film in padded for part in (film, gap)][:-1]
    return np.concatenate(parts, axis=2)


def write_film(path: Path, frames: np.ndarray, rate: int = 20) -> None:
    """Write (T, H, W, 3) uint8 as an H.264 film that browsers play; small pictures are enlarged.

    Args:
        path: the file (.mp4). frames: the pictures. rate: frames a second.

    Raises:
        UserError: it cannot be written.
    """
    import av

    scale = max(1, -(-_LEAST_HEIGHT // frames.shape[1]))
    large = frames.repeat(scale, axis=1).repeat(scale, axis=2)
    large = large[:, : large.shape[1] // 2 * 2, : large.shape[2] // 2 * 2]
    with whole_file(path) as aside, av.open(str(aside), "w", format="mp4") as container:
        stream = container.add_stream("libx264", rate=Fraction(rate), options={"crf": "30", "preset": "slow"})
        stream.width, stream.height, stream.pix_fmt = large.shape[2], large.shape[1], "yuv420p"
        for picture in large:
            container.mux(stream.encode(av.VideoFrame.from_ndarray(np.ascontiguousarray(picture), format="rgb24")))
        container.mux(stream.encode())
