"""Decodes one video once, into a few small square frames at even places."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import av
import numpy as np
from av.video.reformatter import Interpolation, VideoReformatter

from repdib_lightning.data.importers.mmact_notes import UnreadableFile

_DAMAGE = (av.FFmpegError, OSError, ValueError, IndexError)


@dataclass(frozen=True)
class Film:
    """What was read of a video.

    Attributes:
        frames: (T, 3, size, size) uint8, none of them of zeros only.
        decoded: frames that the video gave.
        broken: why there were no more, or empty: the video was read to its end.
    """

    frames: np.ndarray
    decoded: int
    broken: str = ""


def read_film(file: Path, size: int, frames: int) -> Film:
    """Decode a video from its first to its last frame, and keep frames in the middle of as many even parts.

    Each decoded frame is resized until its short side has ``size`` pixels (averaging areas), and its middle square is
    kept. Places count the frames that were decoded, whatever the file says of their number; of fewer frames than are
    wanted, some are repeated.

    Raises:
        UnreadableFile: not one frame can be decoded.
    """
    resizer = VideoReformatter()
    squares: list[np.ndarray] = []
    broken = ""
    try:
        for frame in _decoded(file):
            squares.append(_square(resizer, frame, size))
    except _DAMAGE as error:
        broken = _reason(error)
    if not squares:
        raise UnreadableFile(f"is no readable video ({broken or 'it has no frames'})")
    chosen = np.stack([squares[place] for place in places(len(squares), frames)])
    chosen[~chosen.any(axis=(1, 2, 3)), 0, 0, 0] = 1  # frames of zeros are missing ones
    return Film(chosen, len(squares), broken)


def check_video(file: Path) -> None:
    """Decode the first frame.

    Raises:
        UnreadableFile: that fails.
    """
    try:
        if next(_decoded(file), None) is not None:
            return
        reason = "it has no frames"
    except _DAMAGE as error:
        reason = _reason(error)
    raise UnreadableFile(f"is no readable video ({reason})")


def places(decoded: int, wanted: int) -> list[int]:
    """Numbers of the frames in the middle of ``wanted`` even parts of ``decoded`` frames."""
    return [(2 * part + 1) * decoded // (2 * wanted) for part in range(wanted)]


def _decoded(file: Path) -> Iterator[av.VideoFrame]:
    with av.open(str(file)) as container:
        stream = container.streams.video[0]
        stream.codec_context.thread_count = 1  # which frames come before damage depends on it, and trials are parallel
        yield from container.decode(stream)


def _square(resizer: VideoReformatter, frame: av.VideoFrame, size: int) -> np.ndarray:
    """(3, size, size) uint8."""
    short = min(frame.width, frame.height)
    width, height = (max(size, round(side * size / short)) for side in (frame.width, frame.height))
    small = resizer.reformat(frame, width, height, "rgb24", interpolation=Interpolation.AREA).to_ndarray()
    left, top = (width - size) // 2, (height - size) // 2
    return small[top : top + size, left : left + size].transpose(2, 0, 1)


def _reason(error: BaseException) -> str:
    if isinstance(error, IndexError):
        return "no video in it"
    return getattr(error, "strerror", None) or str(error).partition("\n")[0]
