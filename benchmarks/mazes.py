"""How fast do many mazes step? All at once, beside one after another, and beside drawing nothing but blank pictures."""

from __future__ import annotations

import argparse
from collections.abc import Callable

import gymnasium
import numpy as np

from benchmarks.measuring import alternate
from benchmarks.reporting import claim, machine, table
from repdib_lightning.environments import register

COUNT, STEPS = 64, 50


def steps_of(mode: str, **options: object) -> Callable[[], None]:
    """Random steps of vectorised mazes."""
    mazes = gymnasium.make_vec("repdib/SpiralWorld-v0", num_envs=COUNT, vectorization_mode=mode, **options)
    mazes.reset(seed=0)
    actions = np.random.default_rng(0).integers(4, size=(STEPS, COUNT))

    def step() -> None:
        for chosen in actions:
            mazes.step(chosen)

    return step


def blank() -> None:
    """As many bytes as the pictures of these steps have, written once."""
    for _ in range(STEPS):
        np.zeros((COUNT, 3, 30, 30), np.uint8).fill(1)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rounds", type=int, default=20)
    options = parser.parse_args()
    register()
    contenders = {
        "blank pictures": blank,
        "all at once": steps_of("vector_entry_point"),
        "one after another (gymnasium's sync)": steps_of("sync"),
        "all at once, with a video": steps_of("vector_entry_point", distractors="procedural"),
    }
    took = alternate(contenders, options.rounds, warmup=1)
    print("## Mazes\n")
    told = f"{STEPS} steps of {COUNT} mazes, pictures included"
    print(f"{machine()}. Median of {options.rounds} rounds in turn: {told}.\n")
    rows = [[what, 1e6 * took[what] / STEPS, took.ratio(what, "all at once")] for what in contenders]
    print(table(["what", "µs a step of all", "all at once = 1"], rows) + "\n")
    ratio = took.ratio("one after another (gymnasium's sync)", "all at once")
    print(claim("one after another, relative to all at once", ratio, at_least=10.0))


if __name__ == "__main__":
    main()
