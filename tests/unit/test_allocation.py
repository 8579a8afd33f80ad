"""Freed memory is used again instead of mapped anew, unless the user chose otherwise."""

import os
import platform
import subprocess
import sys

import pytest

MEASURE = """
import ctypes, resource, sys
from repdib_lightning.allocation import keep_freed_memory
print(keep_freed_memory())
library = ctypes.CDLL(None)
library.malloc.restype, library.malloc.argtypes = ctypes.c_void_p, [ctypes.c_size_t]
library.memset.argtypes, library.free.argtypes = [ctypes.c_void_p, ctypes.c_int, ctypes.c_size_t], [ctypes.c_void_p]
size, faults = 48 << 20, []
for _ in range(4):
    before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    block = library.malloc(size)
    library.memset(block, 1, size)
    library.free(block)
    faults.append(resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before)
print(*faults)
"""


def measure(**environment):
    kept = {key: value for key, value in os.environ.items() if not key.startswith("MALLOC_")}
    done = subprocess.run(
        [sys.executable, "-c", MEASURE], env={**kept, **environment}, capture_output=True, text=True, check=True
    )
    told, faults = done.stdout.splitlines()
    return told == "True", [int(count) for count in faults.split()]


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="other C libraries keep their own rules")
def test_the_second_use_of_a_block_maps_nothing():
    told, faults = measure()
    assert told
    assert faults[0] > 20 * (max(faults[1:]) + 1)


def test_a_choice_of_the_user_is_left_alone():
    told, faults = measure(MALLOC_TRIM_THRESHOLD_="131072")
    assert not told
    if platform.libc_ver()[0] == "glibc":
        assert min(faults[1:]) > faults[0] / 2
