"""Options that take several words: one word, words between commas, or a list."""

from __future__ import annotations

from collections.abc import Sequence

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
