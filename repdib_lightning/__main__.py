"""The command line: one word chooses what to do; everything heavy is imported only then."""

from __future__ import annotations

import importlib
import os
import sys

from repdib_lightning.allocation import keep_freed_memory
from repdib_lightning.errors import UserError, nearest

VERBS = {
    "fit": ("repdib_lightning.cli:fit", "train; without a configuration, the robot arm with RepDIB"),
    "validate": ("repdib_lightning.cli:validate", "losses of a run on its held-out episodes"),
    "test": ("repdib_lightning.cli:test", "the same, under test/"),
    "collect": ("repdib_lightning.verbs:collect", "make a data set: collect robot_arm data/robot_arm.h5"),
    "import": ("repdib_lightning.verbs:import_data", "convert a data set: import vd4rl FOLDER data/walker.h5"),
    "inspect": ("repdib_lightning.verbs:inspect", "what is in a data file, what is wrong with it, a contact sheet"),
    "export": ("repdib_lightning.verbs:export", "make a frozen encoder bundle of a run: export runs/x"),
    "encode": ("repdib_lightning.verbs:encode", "a data set as vectors: encode runs/x data/x.h5 data/x_latents.h5"),
    "features": (
        "repdib_lightning.verbs:features",
        "videos as features of frames: features data/x.h5 data/y.h5",
    ),
    "probe": ("repdib_lightning.verbs:probe", "what a bundle kept and dropped: probe runs/x/bundle data/x.h5"),
    "figures": ("repdib_lightning.verbs:figures", "what each group draws: figures factors runs/x/bundle data/x.h5"),
    "compare": ("repdib_lightning.verbs:compare", "probe several bundles side by side into one HTML report"),
    "finetune": ("repdib_lightning.verbs:finetune", "RL on a bundle: finetune dqn --env SpiralWorld --encoder BUNDLE"),
    "suite": ("repdib_lightning.verbs:suite", "grids of runs over seeds: suite run|status|report robot_arm"),
}


def usage() -> str:
    """The text of ``--help``."""
    lines = [f"  {verb:<10}{about}" for verb, (_, about) in VERBS.items()]
    return "\n".join(
        [
            "usage: python -m repdib_lightning VERB [options]      (VERB --help lists the options)",
            "",
            "Learns representations that keep the state and drop the noise (RepDIB), and shows what they kept.",
            "",
            *lines,
        ]
    )


def run(arguments: list[str]) -> int:
    """Run one verb. Returns its exit code; raises UserError for bad input."""
    if not arguments or arguments[0] in ("-h", "--help"):
        print(usage())
        return 0 if arguments else 2
    if arguments[0] == "--version":
        print(importlib.import_module("repdib_lightning").__version__)
        return 0
    verb, rest = arguments[0], arguments[1:]
    if verb not in VERBS:
        raise UserError(f"unknown verb '{verb}', {nearest(verb, VERBS)}")
    # Threads that spin long while they wait for each other slow each other down wherever the machine has something else
    # to do. GNU's OpenMP reads this when torch is first imported.
    os.environ.setdefault("GOMP_SPINCOUNT", "5000")
    keep_freed_memory()
    module, _, function = VERBS[verb][0].partition(":")
    return int(getattr(importlib.import_module(module), function)(rest) or 0)


def main(arguments: list[str] | None = None) -> int:
    """Run the command line; a user's mistake becomes one line on stderr and exit code 2.

    Set ``REPDIB_TRACEBACK=1`` to see where the message came from.
    """
    try:
        return run(sys.argv[1:] if arguments is None else arguments)
    except UserError as error:
        if os.environ.get("REPDIB_TRACEBACK"):
            raise
        print(f"error: {' '.join(str(error).split())}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("interrupted", file=sys.stderr)
        return 130
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0


if __name__ == "__main__":
    sys.exit(main())
