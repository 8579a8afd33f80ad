"""Reads one picture file as a square of a given size."""

from __future__ import annotations

import struct
import zlib
from pathlib import Path

import numpy as np
from PIL import Image

from repdib_lightning.errors import UserError

UNREADABLE = (OSError, SyntaxError, ValueError, EOFError, struct.error, zlib.error, Image.DecompressionBombError)
"""What Pillow raises for files that are no pictures, or damaged ones."""
_PNG, _DEPTH = b"\x89PNG\r\n\x1a\n", 24  # signature, and where the bits a channel stand behind it


def read_square(path: Path, size: int) -> tuple[np.ndarray, str]:
    """Decode a picture, lay what is transparent on white, cut the middle square out of it and resize that.

    Resizing is bilinear with antialiasing.

    Args:
        path: a file that Pillow reads, of at most 8 bits a channel.
        size: H and W in pixels.

    Returns:
        (3, H, W) uint8, and how the file held it: a mode of Pillow such as ``RGB`` or ``L``, with
        `` with transparency`` behind it where the mode does not tell.

    Raises:
        UserError: naming the file: unreadable, or more than 8 bits a channel.
    """
    try:
        with Image.open(path) as file:
            mode, image = (file.mode, None) if is_deep(path, file.mode) else (_described(file), _on_white(file))
    except UNREADABLE as error:
        reason = getattr(error, "strerror", None) or str(error).partition("\n")[0]
        raise UserError(f"{path}: not a readable picture ({reason})") from error
    if image is None:
        raise UserError(f"{path}: has more than 8 bits a channel (mode {mode}); convert it to 8 bits")
    side = min(image.size)
    left, top = (image.width - side) // 2, (image.height - side) // 2
    square = image.crop((left, top, left + side, top + side))
    resized = square.resize((size, size), Image.Resampling.BILINEAR)
    return np.ascontiguousarray(np.asarray(resized).transpose(2, 0, 1)), mode


def is_deep(path: Path, mode: str) -> bool:
    """Whether a picture has more than 8 bits a channel, which Pillow would cut off, some without a word in its mode."""
    with open(path, "rb") as stream:
        head = stream.read(_DEPTH + 1)
    return mode.startswith(("I", "F")) or (head.startswith(_PNG) and head[_DEPTH] > 8)


def _described(image: Image.Image) -> str:
    hidden = image.has_transparency_data and not image.mode.upper().endswith("A")
    return f"{image.mode} with transparency" if hidden else image.mode


def _on_white(image: Image.Image) -> Image.Image:
    if not image.has_transparency_data:
        return image.convert("RGB")
    white = Image.new("RGBA", image.size, (255, 255, 255, 255))
    return Image.alpha_composite(white, image.convert("RGBA")).convert("RGB")
