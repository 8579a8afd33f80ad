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
    """Return a hint like ``did you mean 'vib'? (choices: none, vib, vq)``, or ``choices: none, vib, vq``.

    It goes on behind a comma: ``unknown head 'x', choices: linear, mlp``. Without choices it is empty.
    """
    listed = sorted(set(choices))
    close = difflib.get_close_matches(word, listed, n=1, cutoff=0.5)
    shown = "choices: " + ", ".join(listed[:12]) + (", ..." if len(listed) > 12 else "")
    if close:
        return f"did you mean '{close[0]}'? ({shown})"
    return shown if listed else ""
