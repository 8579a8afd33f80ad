"""How large is a replay of a million transitions, how much memory does drawing from it take, and how fast is it?"""

from __future__ import annotations

import argparse
import tempfile
import time
from pathlib import Path

import numpy as np

from benchmarks.measuring import resident, seconds
from benchmarks.reporting import claim, machine, median, table
from repdib_lightning.records import ArraySpec
from repdib_lightning.rl.exploration.replay import Replay, ReplayPlan

STEPS, ACTIONS, SIZE, BATCH = 500, 6, 84, 1024
PUBLISHED = 63.5
"""GB that the replay of URLB's program takes: a million files' worth of stacked pictures, 63.5 kB a transition."""


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--transitions", type=int, default=1_000_000)
    parser.add_argument("--draws", type=int, default=50)
    parser.add_argument("--folder", type=Path, default=None, help="where the file is written")
    options = parser.parse_args()
    episodes = -(-options.transitions // STEPS)
    plan = ReplayPlan({"pixels": ArraySpec((3, SIZE, SIZE))}, ACTIONS, episodes, STEPS)
    with tempfile.TemporaryDirectory(dir=options.folder) as folder:
        path = Path(folder) / "replay.h5"
        replay = Replay(path, plan, n_steps=3, frame_stack=3)
        before = resident("VmRSS")
        began = time.perf_counter()
        fill(replay, episodes)
        wrote = time.perf_counter() - began
        took = [seconds(lambda number=number: replay.draw(number, BATCH)) for number in range(options.draws)]
        peak = resident("VmHWM")
        replay.finish()
        report(plan, path, wrote, median(took), peak, before)


def fill(replay: Replay, episodes: int) -> None:
    """Write episodes of random pictures."""
    random = np.random.default_rng(0)
    pictures = random.integers(256, size=(STEPS + 1, 3, SIZE, SIZE), dtype=np.uint8)
    for _ in range(episodes):
        actions = random.uniform(-1.0, 1.0, (STEPS, ACTIONS)).astype(np.float32)
        rewards = random.uniform(size=STEPS).astype(np.float32)
        replay.add({"observations": {"pixels": pictures}, "actions": actions, "rewards": rewards, "factors": {}})


def report(plan: ReplayPlan, path: Path, wrote: float, drawn: float, peak: int, before: int) -> None:
    """The table and what was asked for."""
    transitions = plan.episodes * plan.steps
    size = path.stat().st_size / 1e9
    print("## Replay\n")
    print(f"{machine()}. {transitions:,} transitions of {SIZE} x {SIZE} pixels, stacks of 3, batches of {BATCH}.\n")
    rows = [
        ["on disk", f"{size:.1f} GB"],
        ["on disk, published program", f"{PUBLISHED * transitions / 1e6:.1f} GB"],
        ["largest memory of the process while written and drawn from", f"{peak / 1e9:.2f} GB"],
        ["of these before, mostly imports", f"{before / 1e9:.2f} GB"],
        ["writing", f"{transitions / wrote:.0f} transitions a s"],
        ["drawing a batch", f"{1e3 * drawn:.0f} ms"],
        ["copying as many bytes", f"{1e3 * copying():.0f} ms"],
    ]
    print(table(["", ""], rows) + "\n")
    print(claim("GB on disk of a million", size * 1e6 / transitions, at_most=22.0))
    print(claim("GB of memory", peak / 1e9, at_most=2.0))


def copying() -> float:
    """Seconds to copy what a batch holds from memory to memory."""
    batch = np.ones((BATCH, 2, 9, SIZE, SIZE), np.uint8)
    return median(seconds(batch.copy) for _ in range(5))


if __name__ == "__main__":
    main()
