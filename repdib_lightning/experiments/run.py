"""``suite run`` and ``suite status``."""

from __future__ import annotations

import contextlib
import itertools
import json
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
from repdib_lightning.experiments.attempt import forget
from repdib_lightning.experiments.executors import Executor, build_executor
from repdib_lightning.experiments.points import Point, State, points_of
from repdib_lightning.experiments.slurm import jobs_in_queue
from repdib_lightning.experiments.suite import PHASES, Suite, check_seeds
from repdib_lightning.experiments.suite_file import read_suite
from repdib_lightning.verbs import Outcome, check_finetune
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
) -> Outcome:
    """Run every point of a suite that is not finished: fit, export, probe, finetune, each in its own folder.

    What was stopped, killed or failed goes on where it stopped; what is finished is left alone.

    Args:
        suite: a YAML file, or the name of a packaged suite.
        executor: local (child processes) or slurm (an array job; returns when it is in the queue).
        jobs: points at a time; by default as many as there are cores for, or as the suite's slurm parameters say.
        tune: use the development seeds (100 and up) instead of the reported ones.
        seeds: other seeds than the suite's, between commas.
        only: settings or grids to run, between commas, such as none,repdib.
        redo: do this phase (fit, export, probe or finetune) and what depends on it anew; the old results are removed
            at once.
        runs: folder of all suites' runs.

    Returns:
        How the points stand now; the exit code is 1 where one failed.

    Raises:
        UserError: a bad suite or option. Points that fail do not end the others.
    """
    plan = read_suite(suite)
    points = chosen_points(plan, tune=tune, seeds=seeds, only=only, runs=runs)
    known = [phase for phase in PHASES if any(phase in point.setting.phases for point in points)]
    if redo and redo not in known:
        raise UserError(f"--redo: no phase is called '{redo}', {nearest(redo, known)}")
    chosen = build_executor(executor, runs / plan.name, jobs, plan.threads, plan.slurm)
    unfinished = ("waiting", "stopped", "failed")
    redone = {point.name for point in points if redo in point.setting.phases}
    stands = [(point, state) for point, state, _ in standing(points)]
    todo = [p for p, state in stands if state in unfinished or (state == "finished" and p.name in redone)]
    check_finetunings(plan, todo)
    prepare_data(plan, todo)
    check_finetunings(plan, [point for point in todo if point.setting.data is not None])  # more is known with the data
    for point in todo:
        if point.name in redone:
            forget(point, redo)
    if chosen.returns_at_once:
        chosen.submit(todo)
        return Outcome(f"submitted {len(todo)}    look: python -m repdib_lightning suite status {suite}")
    _watch(plan, chosen, points, todo)
    failed = any(state == "failed" for _, state, _ in standing(points))
    return Outcome(summary(points), exit_code=int(failed))


def suite_status(suite: Path, *, tune: bool = False, seeds: str = "", only: str = "", runs: Path = RUNS) -> str:
    """How every point of a suite stands.

    Args:
        suite, tune, seeds, only, runs: as in ``suite run``.
    """
    plan = read_suite(suite)
    points = chosen_points(plan, tune=tune, seeds=seeds, only=only, runs=runs)
    rows = []
    for point, state, detail in standing(points):
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
        numbers = list(dict.fromkeys(int(word) for word in words(seeds, "--seeds"))) if seeds else default
    except ValueError as error:
        raise UserError(f"--seeds: expected numbers between commas, got '{seeds}'") from error
    if min(numbers) < 0:
        raise UserError(f"--seeds: must be at least 0, is {min(numbers)}")
    check_seeds(numbers, tune=tune, where="--seeds")
    return points_of(plan, numbers, runs, _places(plan, words(only, "--only")) if only else ())


def _places(plan: Suite, wanted: Sequence[str]) -> list[str]:
    """Where the runs of these grids and settings are; a setting may share a run with one of another grid."""
    found: dict[str, list[str]] = {}
    for setting in (setting for grid in plan.grids for setting in grid.settings):
        for name in {setting.grid, setting.name, setting.place}:
            found.setdefault(name, []).append(plan.run_by(setting).place)
    for word in wanted:
        if word not in found:
            raise UserError(f"--only: no setting or grid is called '{word}', {nearest(word, found)}")
    return [place for word in wanted for place in found[word]]


def standing(points: Sequence[Point]) -> list[tuple[Point, State, str]]:
    """How points stand. One whose job is no longer in the queue (cancelled, or its machine is gone) is stopped."""
    states = [(point, *point.state()) for point in points]
    if all(state != "queued" for _, state, _ in states):
        return states
    known = {f"job {job}" for job in jobs_in_queue()}
    for index, (point, state, detail) in enumerate(states):
        if state == "queued" and detail not in known:
            states[index] = (point, "stopped", f"{detail} is not in the queue")
    return states


def check_finetunings(plan: Suite, points: Sequence[Point]) -> None:
    """Check each different fine-tuning of the points once, since hours of pre-training come before the first of them.

    Raises:
        UserError: naming the suite's file, the fine-tuning and what is wrong with its options.
    """
    checked = set()
    for point in points:
        for name, arguments in point.finetune.items():
            given = point.encoder_of(name)
            encoder = [] if given is None else ["--encoder", str(given)]
            different = (*arguments[: arguments.index("--seed")], bool(encoder))
            if different in checked:
                continue
            checked.add(different)
            try:
                check_finetune([*arguments, *encoder])
            except UserError as error:
                raise UserError(f"{plan.file}: finetune run '{name}' of {point.setting.place}: {error}") from error


def prepare_data(plan: Suite, points: Sequence[Point]) -> None:
    """Collect the points' stores where they are absent, before anything needs them.

    Raises:
        UserError: one of them cannot be read.
    """
    commands = {store: words for grid in plan.grids for store, words in grid.stores.items()}
    needed = ((point.setting.data, point.setting.probe_data) for point in points)
    for store in dict.fromkeys(itertools.chain.from_iterable(needed)):
        if store is None:
            continue
        if not store.exists() and commands[store]:
            from repdib_lightning.verbs import collect

            collect([commands[store][0], str(store), *commands[store][1:]])
        check_recorded_as(EpisodeStore(store), commands[store], plan.file)


def check_recorded_as(store: EpisodeStore, words: Sequence[str], suite: Path) -> None:
    """Check that a store was recorded by a ``collect`` command, as far as it tells.

    Args:
        store: what is there. words: of the command, environment first. suite: file that has the command.

    Raises:
        UserError: naming the store and the option that differs.
    """
    recorded = json.loads(store.attributes.get("configuration", "{}"))
    for option, value in itertools.pairwise(words):
        name = option.removeprefix("--")
        if option.startswith("--") and name in recorded and str(recorded[name]) != value:
            raise UserError(
                f"{store.path}: was recorded with {name} {recorded[name]}, {suite} collects it with {value}; remove "
                "the file, or name another one"
            )


def summary(points: Sequence[Point]) -> str:
    """``31 finished, 2 running, 2 waiting of 35 points`` and the failed ones by name."""
    states = standing(points)
    counts = Counter(state for _, state, _ in states)
    order: tuple[State, ...] = ("finished", "running", "queued", "stopped", "failed", "waiting")
    said = ", ".join(f"{counts[state]} {state}" for state in order if counts[state])
    failed = [f"failed: {point.name}: {error}    ({point.log})" for point, state, error in states if state == "failed"]
    return "\n".join([f"{said} of {len(points)} points", *failed])


def _watch(plan: Suite, executor: Executor, points: Sequence[Point], todo: Sequence[Point]) -> None:
    """Run what is to be done, and show how all points stand until it has ended."""
    told = {point.name for point, state, _ in standing(points) if state == "finished"}
    with (
        _terminated_like_a_keyboard(),
        tqdm(total=len(points), desc=f"suite {plan.name}", unit="point", disable=not sys.stderr.isatty()) as bar,
    ):
        try:
            executor.submit(todo)
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
    """SIGTERM to this process, or the end of its terminal, ends its children too (unless ignored, as under nohup)."""

    def leave(number: int, _: object) -> None:
        raise SystemExit(128 + number)

    before = {number: signal.getsignal(number) for number in (signal.SIGTERM, signal.SIGHUP)}
    heeded = [number for number, handler in before.items() if handler is not signal.SIG_IGN]
    for number in heeded:
        signal.signal(number, leave)
    try:
        yield
    finally:
        for number in heeded:
            signal.signal(number, before[number])
