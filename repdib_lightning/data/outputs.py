"""Checks of a file to be written, made before the work whose result it will hold."""

from __future__ import annotations

import tempfile
from collections.abc import Iterable
from pathlib import Path

from repdib_lightning.errors import UserError


def check_output_file(path: Path, option: str, suffix: str, inputs: Iterable[Path] = ()) -> None:
    """Check that a file can be written and that nothing the work needs would be lost by it. Leaves nothing behind.

    Args:
        path: the file to be written.
        option: what the user calls it, for the message.
        suffix: the ending it must have, so that a data set or a bundle named by mistake is not replaced.
        inputs: files that the work reads.

    Raises:
        UserError: naming the option: another ending, an input, a folder, or a place that cannot be written to.
    """
    if path.suffix.lower() != suffix:
        raise UserError(f"{option} must end in {suffix}, is '{path}'")
    for given in inputs:
        if path.resolve() == given.resolve():
            raise UserError(f"{option} would replace {given}, which is read; choose another name than '{path}'")
    if path.is_dir():
        raise UserError(f"{option} {path}: cannot be written (is a folder)")
    _try_to_write(path, option)


def _try_to_write(path: Path, option: str) -> None:
    """Open a nameless file in the nearest folder that exists, since permission bits do not tell all."""
    try:
        folder = path.absolute().parent
        while not folder.exists():
            folder = folder.parent
        with tempfile.TemporaryFile(dir=folder):
            pass
    except OSError as error:
        raise UserError(f"{option} {path}: cannot be written ({error.strerror or error})") from error
