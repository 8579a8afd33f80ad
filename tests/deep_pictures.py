"""Pictures of 16 bits a channel, which Pillow can read but not write in colour."""

from __future__ import annotations

import struct
import zlib
from pathlib import Path


def sixteen_bit_rgb(path: Path) -> None:
    """A PNG of 4 x 4 pixels, which Pillow opens as RGB."""

    def chunk(kind: bytes, content: bytes) -> bytes:
        return struct.pack(">I", len(content)) + kind + content + struct.pack(">I", zlib.crc32(kind + content))

    rows = (b"\0" + bytes(6 * 4)) * 4
    head = struct.pack(">IIBBBBB", 4, 4, 16, 2, 0, 0, 0)
    parts = chunk(b"IHDR", head) + chunk(b"IDAT", zlib.compress(rows)) + chunk(b"IEND", b"")
    path.write_bytes(b"\x89PNG\r\n\x1a\n" + parts)
