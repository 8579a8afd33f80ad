"""Modules that remember the plain arguments they were built with, so that a bundle can rebuild them."""

from __future__ import annotations

import functools
import inspect
from typing import Any

from torch import nn


class RememberedArguments(nn.Module):
    """An ``nn.Module`` whose subclasses record their keyword arguments in ``self.arguments``.

    The first constructor parameters (a spec or a width, supplied by the package; ``supplied`` of them) are left out;
    everything else must be plain: strings, numbers, booleans, None, and lists or dictionaries of these. Those in
    ``forgotten``, which say where training started and change nothing of a module that is filled with weights, are left
    out too.
    """

    supplied: int = 1
    forgotten: tuple[str, ...] = ()
    arguments: dict[str, Any]

    def __init_subclass__(cls, **kwargs: Any) -> None:
        super().__init_subclass__(**kwargs)
        if "__init__" not in cls.__dict__:
            return
        build = cls.__init__
        signature = inspect.signature(build)

        @functools.wraps(build)
        def recording_build(self: RememberedArguments, *args: Any, **given: Any) -> None:
            if type(self) is cls:
                bound = signature.bind(self, *args, **given)
                bound.apply_defaults()
                kept = list(bound.arguments.items())[1 + cls.supplied :]
                arguments = {name: value for name, value in kept if name not in cls.forgotten}
            build(self, *args, **given)
            if type(self) is cls:
                self.arguments = arguments

        cls.__init__ = recording_build  # type: ignore[assignment, method-assign]
