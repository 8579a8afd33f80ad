"""The one exception for what a user can get wrong, and the search for the nearest valid choice."""

from __future__ import annotations

import difflib
from collections.abc import Iterable


class UserError(ValueError):
    """Bad input: one line that names the file, key or option and the nearest valid choice.

    The command line prints it without a traceback and exits with code 2. Code that finds a mistake of our own
    uses ``assert`` instead.
    """


def nearest(word: str, choices: Iterable[str]) -> str:
    """Return a hint like ``did you mean 'vib'? (choices: none, vib, vq)`` for an unknown word."""
    listed = sorted(choices)
    close = difflib.get_close_matches(word, listed, n=1, cutoff=0.5)
    guess = f"did you mean '{close[0]}'? " if close else ""
    shown = ", ".join(listed[:12]) + (", ..." if len(listed) > 12 else "")
    return f"{guess}(choices: {shown})" if listed else guess.strip()
