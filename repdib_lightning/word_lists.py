"""Several words or numbers: as options take them, and as messages tell them."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from repdib_lightning.errors import UserError


def words(given: str | Sequence[str], option: str) -> tuple[str, ...]:
    """Split ``linear``, ``linear,mlp`` or ``[linear, mlp]`` into its words; a sequence of words stays as it is.

    Raises:
        UserError: naming the option: anything but words, or no word at all.
    """
    parts = given.strip().removeprefix("[").removesuffix("]").split(",") if isinstance(given, str) else given
    if not isinstance(parts, Sequence) or not all(isinstance(part, str) for part in parts):
        raise UserError(f"{option}: expected a word or words between commas, got {given!r:.60}")
    chosen = tuple(dict.fromkeys(part.strip(" '\"") for part in parts))
    if not all(chosen) or not chosen:
        raise UserError(f"{option}: expected a word or words between commas, got {given!r:.60}")
    return chosen


def in_ranges(numbers: Iterable[int]) -> str:
    """``1-3, 5`` of 1, 2, 3 and 5; ``none`` of none."""
    runs: list[list[int]] = []
    for number in sorted(numbers):
        if runs and number == runs[-1][1] + 1:
            runs[-1][1] = number
        else:
            runs.append([number, number])
    return ", ".join(str(first) if first == last else f"{first}-{last}" for first, last in runs) or "none"
