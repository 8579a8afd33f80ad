"""Numbers, sizes and tables as text."""

from __future__ import annotations

import numpy as np


def short_number(value: float | np.generic) -> str:
    """Whole numbers as they are, others with three significant digits."""
    number = float(value)
    return f"{int(number)}" if number.is_integer() and abs(number) < 1e9 else f"{number:.3g}"


def file_size(count: float) -> str:
    """Bytes in the largest binary unit that keeps the number above 1."""
    for unit in ("B", "KiB", "MiB"):
        if count < 1024:
            return f"{count:.0f} {unit}" if unit == "B" else f"{count:.1f} {unit}"
        count /= 1024
    return f"{count:.1f} GiB"


def spread(values: np.ndarray) -> str:
    """Smallest, median and largest of (n,) numbers."""
    return (
        f"min {short_number(values.min())}, median {short_number(np.median(values))}, max {short_number(values.max())}"
    )


def table(rows: list[list[str]]) -> list[str]:
    """Lines with columns aligned left, indented by two."""
    widths = [max(len(row[column]) for row in rows) for column in range(len(rows[0]))]
    return [
        "  " + "  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip() for row in rows
    ]


def bar(share: float, width: int = 24) -> str:
    """A bar of text for a share in [0, 1]."""
    return "█" * round(share * width)
