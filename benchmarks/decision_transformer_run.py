"""Runs a command of the package, and prints the largest memory it took, in GB, as the last line."""

from __future__ import annotations

import resource
import sys

from repdib_lightning import __main__ as command_line

if __name__ == "__main__":
    code = command_line.run(sys.argv[1:])
    print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024 / 1e9)
    sys.exit(code)
