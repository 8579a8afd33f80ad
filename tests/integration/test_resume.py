"""Killed, preempted, interrupted, broken: what is left of a run, and that going on with it changes nothing."""

from __future__ import annotations

import json
import multiprocessing
import signal
from pathlib import Path
from typing import Any

import pytest
import toy_training

STEPS = {"max_steps": 15, "max_epochs": -1}
EPOCHS = {"max_epochs": 3}
RUNS: dict[str, dict[str, Any]] = {
    "steps": {"trainer": {**STEPS, "val_check_interval": 2}, "csv": True},
    "epochs": {"trainer": EPOCHS, "csv": True},
    "plateau": {"trainer": EPOCHS, "schedule": "plateau"},
    "plateau by steps": {"trainer": STEPS, "schedule": "plateau"},
    "without validation": {"trainer": STEPS, "validate": False},
    "accumulated": {"trainer": EPOCHS, "accumulate": 2},
    "loader draws": {"trainer": EPOCHS, "draws": True},
    "two ranks": {"trainer": {**STEPS, "devices": 2, "strategy": "ddp_fork"}},
}
"""Options of toy runs of 15 batches in 3 epochs; the scheduler asks for the number of steps unless it is a plateau."""

KILLED = -int(signal.SIGKILL)


@pytest.fixture(scope="module")
def process() -> Any:
    """Processes that start with Lightning imported, from a server without threads."""
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(
        ["repdib_lightning.callbacks.checkpointing", "repdib_lightning.callbacks.run_status"]
    )

    def run(folder: Path, **options: Any) -> int:
        child = context.Process(target=toy_training.train, args=(str(folder), options))
        child.start()
        child.join()
        assert child.exitcode is not None
        return child.exitcode

    return run


@pytest.fixture(scope="module")
def unbroken(process: Any, tmp_path_factory: pytest.TempPathFactory) -> Any:
    """Folders of runs that nothing stopped."""
    made: dict[tuple[str, int], Path] = {}

    def folder(name: str, workers: int = 0) -> Path:
        if (name, workers) not in made:
            made[name, workers] = tmp_path_factory.mktemp("unbroken") / "run"
            assert process(made[name, workers], workers=workers, **RUNS[name]) == 0
        return made[name, workers]

    return folder


def recorded(folder: Path, rank: int = 0) -> dict[str, str]:
    """What a run did: 'train BATCH' -> loss in hexadecimal, and so on. Whatever was done twice must agree."""
    values: dict[str, str] = {}
    for line in (folder / f"record.{rank}").read_text().splitlines():
        key, _, value = line.rpartition(" ")
        assert values.setdefault(key, value) == value, f"{key} was different the second time"
    return values


def assert_same(folder: Path, reference: Path) -> None:
    """Every loss of training and validation, every epoch's beginning and end, and all weights are the same bits."""
    for path in reference.glob("record.*"):
        rank = int(path.suffix[1:])
        assert recorded(folder, rank) == recorded(reference, rank)
    assert (folder / "weights.json").read_text() == (reference / "weights.json").read_text()


def state(folder: Path) -> str:
    return str(json.loads((folder / "status.json").read_text())["state"])


def checkpoints(folder: Path) -> list[str]:
    return sorted(path.name for path in (folder / "checkpoints").iterdir())


@pytest.mark.parametrize("workers", [0, 2])
@pytest.mark.parametrize(
    ("name", "stops"), [("steps", [3, 8]), ("epochs", [5, 10]), ("steps", [5, 7]), ("epochs", [14])]
)
def test_a_killed_run_goes_on_bit_for_bit(
    process: Any, unbroken: Any, tmp_path: Path, name: str, stops: list[int], workers: int
) -> None:
    run = tmp_path / "run"
    for number, stop in enumerate(stops):
        code = process(run, stop=stop, resume=number > 0, every=3 - len(stops), workers=workers, **RUNS[name])
        assert code == KILLED
    assert process(run, resume=True, workers=workers, **RUNS[name]) == 0
    assert_same(run, unbroken(name, workers))
    assert state(run) == "finished"
    logged = (unbroken(name, workers) / "metrics.csv").read_text().splitlines()
    assert (run / "metrics.csv").read_text().splitlines() == logged


@pytest.mark.parametrize("name", sorted(set(RUNS) - {"steps", "epochs"}))
def test_nothing_that_keeps_state_breaks_the_resume(process: Any, unbroken: Any, tmp_path: Path, name: str) -> None:
    run = tmp_path / "run"
    for number, stop in enumerate([5, 7, 10]):
        assert process(run, stop=stop, resume=number > 0, every=1, **RUNS[name]) in (KILLED, 1)
    assert process(run, resume=True, **RUNS[name]) == 0
    assert_same(run, unbroken(name))


def test_killed_in_the_middle_of_a_validation(process: Any, unbroken: Any, tmp_path: Path) -> None:
    run = tmp_path / "run"
    assert process(run, stop=10, how="kill_in_validation", **RUNS["epochs"]) == KILLED
    assert process(run, resume=True, **RUNS["epochs"]) == 0
    assert_same(run, unbroken("epochs"))


@pytest.mark.parametrize("number", [2, 4])
def test_killed_while_a_checkpoint_is_written(process: Any, unbroken: Any, tmp_path: Path, number: int) -> None:
    run = tmp_path / "run"
    assert process(run, save_killed=number, **RUNS["epochs"]) == KILLED
    written = checkpoints(run)
    assert any(".tmp-" in name for name in written), "the kill did not strike while writing"
    assert f"step-{2 * (number - 2):08d}.ckpt" in written
    assert process(run, resume=True, **RUNS["epochs"]) == 0
    assert_same(run, unbroken("epochs"))
    assert not any(".tmp-" in name for name in checkpoints(run)), "half-written files are left"


def test_a_damaged_checkpoint_is_passed_over_and_then_replaced(process: Any, unbroken: Any, tmp_path: Path) -> None:
    run = tmp_path / "run"
    assert process(run, stop=9, **RUNS["epochs"]) == KILLED
    newest = run / "checkpoints" / "step-00000008.ckpt"
    content = bytearray(newest.read_bytes())
    content[len(content) // 2] ^= 4
    newest.write_bytes(content)
    assert process(run, resume=True, stop=7, every=6, **RUNS["epochs"]) == KILLED
    assert newest.name in checkpoints(run), "nothing is thrown away before there is something newer"
    assert process(run, resume=True, every=5, **RUNS["epochs"]) == 0
    assert f"{newest}: damaged checkpoint passed over" in (run / "stderr.txt").read_text()
    assert checkpoints(run) == ["step-00000006.ckpt", "step-00000010.ckpt", "step-00000015.ckpt"]
    assert_same(run, unbroken("epochs"))


@pytest.mark.parametrize("stop", [4, 5])
def test_sigterm_saves_and_says_so(process: Any, unbroken: Any, tmp_path: Path, stop: int) -> None:
    run = tmp_path / "run"
    name = "without validation"
    assert process(run, stop=stop, how="term", every=100, **RUNS[name]) == 143
    assert state(run) == "preempted"
    assert checkpoints(run) == ["step-00000000.ckpt", f"step-{stop:08d}.ckpt"]
    assert process(run, resume=True, **RUNS[name]) == 0
    assert_same(run, unbroken(name))


def test_sigterm_in_a_validation_goes_back_to_the_last_checkpoint(process: Any, unbroken: Any, tmp_path: Path) -> None:
    run = tmp_path / "run"
    assert process(run, stop=10, how="term", every=9, **RUNS["epochs"]) == 143
    assert checkpoints(run) == ["step-00000000.ckpt", "step-00000009.ckpt"]
    assert process(run, resume=True, **RUNS["epochs"]) == 0
    assert_same(run, unbroken("epochs"))


def test_sigterm_with_half_a_step_accumulated_saves_nothing(process: Any, unbroken: Any, tmp_path: Path) -> None:
    run = tmp_path / "run"
    assert process(run, stop=8, how="term", every=3, **RUNS["accumulated"]) == 143
    assert checkpoints(run)[-1] == "step-00000003.ckpt"  # steps are made after 2, 4, 5 (the epoch's end), 7, 9 batches
    assert process(run, stop=9, how="term", resume=True, every=100, **RUNS["accumulated"]) == 143
    assert checkpoints(run)[-1] == "step-00000005.ckpt"
    assert process(run, resume=True, **RUNS["accumulated"]) == 0
    assert_same(run, unbroken("accumulated"))


def test_the_keyboard_interrupts_without_saving_half_a_step(process: Any, unbroken: Any, tmp_path: Path) -> None:
    run = tmp_path / "run"
    assert process(run, stop=7, how="interrupt", every=5, **RUNS["epochs"]) == 130
    assert state(run) == "interrupted"
    assert checkpoints(run) == ["step-00000000.ckpt", "step-00000005.ckpt"]
    assert process(run, resume=True, **RUNS["epochs"]) == 0
    assert_same(run, unbroken("epochs"))


def test_more_steps_on_resume_continue_inside_the_epoch(process: Any, unbroken: Any, tmp_path: Path) -> None:
    run = tmp_path / "run"
    longer = {**RUNS["plateau by steps"]}
    assert process(run, **{**longer, "trainer": {**STEPS, "max_steps": 8}}) == 0
    assert process(run, resume=True, **longer) == 0
    reference = recorded(unbroken("plateau by steps"))
    assert {key: value for key, value in recorded(run).items() if not key.startswith("epoch_end 7")} == reference


@pytest.mark.parametrize(
    ("how", "every", "said"),
    [
        ("nan", 2, "the loss is not finite at step 7: pull is nan, loss is nan"),
        ("inf", 1, "the loss is not finite at step 7: pull is inf, loss is inf"),
        ("gradient", 1, "after step 7 parameter net.0.bias is not finite"),
    ],
)
def test_a_broken_loss_stops_before_it_is_saved(process: Any, tmp_path: Path, how: str, every: int, said: str) -> None:
    run = tmp_path / "run"
    assert process(run, break_at=7, break_by=how, every=every, **RUNS["epochs"]) == 2
    newest = run / "checkpoints" / "step-00000006.ckpt"
    assert (run / "error.txt").read_text() == f"{said}; the last good checkpoint is {newest}"
    assert checkpoints(run)[-1] == newest.name
    assert state(run) == "failed"
    assert json.loads((run / "status.json").read_text())["error"] == (run / "error.txt").read_text()


@pytest.mark.parametrize(
    ("changed", "said"),
    [
        (
            {"trainer": {**STEPS, "limit_train_batches": 4}},
            "an epoch had 5 batches when the checkpoint was written, has 4",
        ),
        ({"trainer": {**STEPS, "devices": 2, "strategy": "ddp_fork"}}, "was written by 1 processes, this run has 2"),
    ],
)
def test_what_cannot_be_resumed_exactly_is_refused(process: Any, tmp_path: Path, changed: Any, said: str) -> None:
    run = tmp_path / "run"
    assert process(run, stop=4, **RUNS["steps"]) == KILLED
    assert process(run, resume=True, **changed) != 0
    assert said in "".join(path.read_text() for path in run.glob("*.txt"))


def test_without_a_checkpoint_there_is_nothing_to_resume(process: Any, tmp_path: Path) -> None:
    assert process(tmp_path, resume=True, **RUNS["epochs"]) == 2
    assert "no checkpoint to resume from" in (tmp_path / "error.txt").read_text()
