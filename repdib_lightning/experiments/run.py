"""``suite run`` and ``suite status``."""

from __future__ import annotations

import contextlib
import os
import signal
import sys
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path

from tqdm import tqdm

from repdib_lightning.data.episodes import EpisodeStore
from repdib_lightning.errors import UserError, nearest
from repdib_lightning.evaluation.tables import Table
from repdib_lightning.experiments.executors import Executor, build_executor
from repdib_lightning.experiments.points import PHASES, Point, State, points_of
from repdib_lightning.experiments.suite import Suite, check_seeds, read_suite
from repdib_lightning.word_lists import words

RUNS = Path("runs/suites")
_LOOK_EVERY = 1.0


def run_suite(
    suite: Path,
    *,
    executor: str = "local",
    jobs: int | None = None,
    tune: bool = False,
    seeds: str = "",
    only: str = "",
    redo: str = "",
    runs: Path = RUNS,
) -> str:
    """Run every point of a suite that is not finished: fit, export, probe, each in its own folder.

    What was stopped, killed or failed goes on where it stopped; what is finished is left alone.

    Args:
        suite: a YAML file, or the name of a packaged suite.
        executor: local (child processes) or slurm (an array job; returns when it is in the queue).
        jobs: points at a time; by default as many as there are cores for.
        tune: use the development seeds (100 and up) instead of the reported ones.
        seeds: other seeds than the suite's, between commas.
        only: settings or grids to run, between commas, such as none,repdib.
        redo: do this phase (fit, export or probe) and what follows it anew.
        runs: folder of all suites' runs.

    Raises:
        UserError: a bad suite or option. Points that fail do not end the others; they are counted at the end.
    """
    plan = read_suite(suite)
    points = chosen_points(plan, tune=tune, seeds=seeds, only=only, runs=runs)
    if redo and redo not in PHASES:
        raise UserError(f"--redo: no phase is called '{redo}' {nearest(redo, PHASES)}")
    room = max(1, (os.cpu_count() or 1) // plan.threads) if jobs is None else jobs
    chosen = build_executor(executor, runs / plan.name, room, plan.threads, plan.slurm)
    todo = [point for point in points if _is_to_be_run(point, redo)]
    prepare_data(plan)
    chosen.submit(todo, redo)
    if chosen.returns_at_once:
        return f"{len(todo)} point(s) are in the queue; python -m repdib_lightning suite status {suite}"
    _watch(plan, chosen, points)
    return summary(points)


def suite_status(suite: Path, *, tune: bool = False, seeds: str = "", only: str = "", runs: Path = RUNS) -> str:
    """How every point of a suite stands.

    Args:
        suite, tune, seeds, only, runs: as in ``suite run``.
    """
    plan = read_suite(suite)
    points = chosen_points(plan, tune=tune, seeds=seeds, only=only, runs=runs)
    rows = []
    for point in points:
        state, detail = point.state()
        seconds = sum(point.record().seconds.values())
        rows.append([point.setting.place, str(point.seed), state, f"{seconds:.0f}", detail[:90]])
    return "\n".join([Table(["point", "seed", "state", "seconds", ""], rows).text(), "", summary(points)])


def chosen_points(plan: Suite, *, tune: bool, seeds: str, only: str, runs: Path) -> list[Point]:
    """The points that the options name.

    Raises:
        UserError: a seed that is no number or of the wrong kind, or an unknown setting.
    """
    default = plan.tune_seeds if tune else plan.seeds
    try:
        numbers = [int(word) for word in words(seeds, "--seeds")] if seeds else default
    except ValueError as error:
        raise UserError(f"--seeds: expected numbers between commas, got '{seeds}'") from error
    check_seeds(numbers, tune=tune, where="--seeds")
    wanted = words(only, "--only") if only else ()
    known = {name for s in plan.settings for name in (s.grid, s.name, s.place)}
    for word in wanted:
        if word not in known:
            raise UserError(f"--only: no setting or grid is called '{word}' {nearest(word, known)}")
    return points_of(plan, numbers, runs, wanted)


def prepare_data(plan: Suite) -> None:
    """Collect the store where it is absent, once, before anything needs it. Raises UserError if it cannot be read."""
    if not plan.data.exists() and plan.collect:
        from repdib_lightning.verbs import collect

        collect([plan.collect[0], str(plan.data), *plan.collect[1:]])
    EpisodeStore(plan.data)


def summary(points: Sequence[Point]) -> str:
    """``31 finished, 2 running, 2 waiting of 35 points`` and the failed ones by name."""
    states = [(point, *point.state()) for point in points]
    counts = Counter(state for _, state, _ in states)
    order: tuple[State, ...] = ("finished", "running", "queued", "stopped", "failed", "waiting")
    said = ", ".join(f"{counts[state]} {state}" for state in order if counts[state])
    failed = [f"failed: {point.name}: {error}    ({point.log})" for point, state, error in states if state == "failed"]
    return "\n".join([f"{said} of {len(points)} points", *failed])


def _is_to_be_run(point: Point, redo: str) -> bool:
    state, _ = point.state()
    return state in ("waiting", "stopped", "failed") or (state == "finished" and bool(redo))


def _watch(plan: Suite, executor: Executor, points: Sequence[Point]) -> None:
    """Show how the points stand until all have ended."""
    told: set[str] = set()
    with (
        _terminated_like_a_keyboard(),
        tqdm(total=len(points), desc=f"suite {plan.name}", unit="point", disable=not sys.stderr.isatty()) as bar,
    ):
        try:
            while True:
                busy = executor.busy()
                _show(bar, points, told)
                if not busy:
                    return
                time.sleep(_LOOK_EVERY)
        except (KeyboardInterrupt, SystemExit):
            print("stopping: what runs saves a checkpoint; the same command goes on", file=sys.stderr, flush=True)
            raise
        finally:
            executor.stop()


def _show(bar: tqdm[None], points: Sequence[Point], told: set[str]) -> None:
    """Move the bar; without a terminal, a line for each point that ended."""
    running, ended = [], 0
    for point in points:
        if point.name in told:
            ended += 1
            continue
        state, detail = point.state()
        if state == "running":
            running.append(f"{point.setting.name}/{point.seed} {detail}")
        elif state in ("finished", "failed"):
            ended += 1
            if state == "finished":
                told.add(point.name)
                if bar.disable:
                    seconds = sum(point.record().seconds.values())
                    print(f"{point.name}: finished after {seconds:.0f} s ({len(told)}/{len(points)})", flush=True)
    bar.n = ended
    bar.set_postfix_str(", ".join(running))


@contextlib.contextmanager
def _terminated_like_a_keyboard() -> Iterator[None]:
    """SIGTERM to this process ends its children too."""

    def leave(*_: object) -> None:
        raise SystemExit(143)

    before = signal.signal(signal.SIGTERM, leave)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)
