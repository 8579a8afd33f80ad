"""Memory that training frees stays with the process, to be used again in the next step."""

from __future__ import annotations

import ctypes
import os
import platform

_TRIM_THRESHOLD, _MMAP_MAX = -1, -4
"""Parameters of mallopt(3)."""
_CHOSEN_BY_THE_USER = ("MALLOC_TRIM_THRESHOLD_", "MALLOC_MMAP_MAX_", "MALLOC_MMAP_THRESHOLD_", "LD_PRELOAD")


def keep_freed_memory() -> bool:
    """Tell the C library of this process not to give freed memory back to the system; returns whether it did.

    By default glibc returns large blocks at once and asks for them again in the next step, where the system must map
    and clear every page anew: for the activations of a convolution stack on a CPU that can take nearly as long
    as the arithmetic (``benchmarks/training_step.py``). The price: the process stays as large as it ever was.

    The command line calls this; a script of your own may, before it trains. Nothing happens without glibc, or where
    the environment chooses already (``MALLOC_TRIM_THRESHOLD_``, ``MALLOC_MMAP_MAX_``, ``MALLOC_MMAP_THRESHOLD_``, or
    another allocator by ``LD_PRELOAD``).
    """
    if platform.libc_ver()[0] != "glibc" or any(os.environ.get(name) for name in _CHOSEN_BY_THE_USER):
        return False
    mallopt = ctypes.CDLL(None).mallopt
    return bool(mallopt(_TRIM_THRESHOLD, -1) and mallopt(_MMAP_MAX, 0))
