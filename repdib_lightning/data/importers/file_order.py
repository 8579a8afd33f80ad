"""The order of numbered names."""

from __future__ import annotations

import re


def natural_key(name: str) -> list[tuple[int, int | str]]:
    """Sort key that compares the numbers in a name as numbers: ``2.hdf5`` comes before ``10.hdf5``."""
    return [(1, int(part)) if part.isdecimal() else (0, part) for part in re.split(r"(\d+)", name)]
