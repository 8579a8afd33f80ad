"""Exit codes that tell a scheduler the truth."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

PREEMPTED = 143
"""128 + SIGTERM, as a shell reports it. Lightning itself exits with 0."""

INTERRUPTED = 130
"""128 + SIGINT."""


@contextmanager
def exit_codes() -> Iterator[None]:
    """Wrap ``trainer.fit``: a run stopped by SIGTERM exits with 143, one stopped at the keyboard with 130."""
    try:
        yield
    except SystemExit as ending:
        from lightning.pytorch.utilities.exceptions import SIGTERMException

        if isinstance(ending, SIGTERMException):
            raise SystemExit(PREEMPTED) from ending
        if isinstance(ending.__context__, KeyboardInterrupt):
            raise SystemExit(INTERRUPTED) from ending
        raise
