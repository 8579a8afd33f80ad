"""One point: its record, its lock, and how its state is read from what lies in its folder."""

import json
import os
import subprocess
import sys
import threading
import time
from dataclasses import asdict

import pytest

from repdib_lightning.callbacks.status_file import Status
from repdib_lightning.errors import UserError
from repdib_lightning.experiments.points import Record, points_of
from repdib_lightning.experiments.suite_file import read_suite

SUITE = """
base: [robot_arm]
data: data/robot_arm.h5
grids:
  g:
    with: {model.shift: SHIFT, trainer.max_steps: 5}
    vary: {config: [bottleneck/none, bottleneck/vq]}
"""


def make_point(folder, shift=2, seed=0, more=""):
    path = folder / "mine.yaml"
    path.write_text(SUITE.replace("SHIFT", str(shift)).replace("vary:", f"{more}vary:"))
    return points_of(read_suite(path), [seed], folder / "runs", ["g/none"])[0]


@pytest.fixture
def point(tmp_path):
    return make_point(tmp_path)


def put(point, **fields):
    record = point.record()
    for name, value in fields.items():
        setattr(record, name, value)
    point.write(record)


def train(point, state, step=0):
    """A run's folder as a fit of this process would leave it."""
    point.folder.mkdir(parents=True, exist_ok=True)
    status = Status.of_this_process()
    status.state, status.step = state, step
    status.write(point.folder)


# records


def test_a_point_without_record_has_an_empty_one_and_nothing_is_written(point, tmp_path):
    record = point.record()
    assert record == Record("mine", "g", "none", 0, point.arguments)
    assert not record.finished and not (tmp_path / "runs").exists()


def test_a_record_is_one_line_of_json_and_comes_back_whole(point):
    record = Record(
        *("mine", "g", "none", 0, point.arguments),
        seconds={"fit": 1.5},
        error="two\nlines",
        job="17_3",
        finished=True,
        configuration={"a": {"b": [1, None, "é"]}},
        versions={"torch": "2"},
        data={"file": "x.h5"},
        threads=2,
        factors={"cell": "state"},
        metrics={"linear/cell/kept": 0.1 + 0.2},
    )
    point.write(record)
    text = point.file.read_text()
    assert text.endswith("}\n") and text.count("\n") == 1
    content = asdict(record)
    assert content.pop("finetune") == {}, "without fine-tunings there is no word on them"
    assert content.pop("probed") == {}, "it was probed on what it was trained on"
    assert json.loads(text) == content
    assert point.record() == record
    assert [path.name for path in point.folder.parent.iterdir()] == ["seed_0.json"]


def test_a_measure_that_is_no_number_is_not_written_over_what_is_there(point):
    put(point, error="first")
    before = point.file.read_text()
    with pytest.raises(ValueError, match="JSON"):
        put(point, metrics={"val/loss": float("nan")})
    assert point.file.read_text() == before
    assert [path.name for path in point.folder.parent.iterdir()] == ["seed_0.json"]


@pytest.mark.parametrize("text", ["", "{", "[]", "null", '{"suite": "mine"}', '{"suit": 1}', "\xff"])
def test_a_damaged_record_is_named_and_what_to_do(point, text):
    point.file.parent.mkdir(parents=True)
    point.file.write_bytes(text.encode("latin-1"))
    with pytest.raises(UserError, match=r"seed_0\.json: not a suite's record .*remove it and .*seed_0$") as error:
        point.record()
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"shift": 3}, r"\(--model\.shift 2 then, --model\.shift 3 now\)"),
        ({"more": "about: other words\n    "}, None),
        ({"more": "baseline: vq\n    "}, None),
    ],
)
def test_a_record_of_other_options_is_refused_by_the_first_that_differs(tmp_path, point, changes, said):
    put(point, finished=True)
    changed = make_point(tmp_path, **changes)
    if said is None:  # nothing that a run depends on
        assert changed.record().finished
        return
    with pytest.raises(UserError, match=said) as error:
        changed.record()
    message = str(error.value)
    assert message.startswith(f"{point.folder}: was run with other options") and "\n" not in message
    with pytest.raises(UserError, match="other options"):
        changed.state()
    # What the message says to remove is what stands in the way.
    assert str(point.file) in message
    point.file.unlink()
    assert not changed.record().finished


def test_options_that_were_added_or_left_out_are_told(point):
    record = point.record()
    for arguments, said in (
        ([*point.arguments, "--model.more", "1"], r"--model\.more then, nothing now"),
        (point.arguments[:-2], r"nothing then, --data\.seed now"),
        (["--other", *point.arguments], r"\(--other then, --config now\)"),
    ):
        record.arguments = arguments
        point.write(record)
        with pytest.raises(UserError, match=said):
            point.record()


def test_every_seed_and_setting_has_its_own_files(tmp_path):
    points = points_of(make_point(tmp_path).suite, [0, 1], tmp_path / "runs")
    assert [p.name for p in points] == ["g/none seed 0", "g/vq seed 0", "g/none seed 1", "g/vq seed 1"]
    files = [file for p in points for file in (p.folder, p.file, p.log)]
    assert len(set(files)) == 12
    assert {file.parent.parent for file in files} == {tmp_path / "runs" / "mine" / "g"}


# locks


def test_a_point_is_held_by_one_at_a_time(tmp_path, point):
    other = make_point(tmp_path, seed=1)
    with point.lock() as first:
        assert first is not None
        with point.lock() as second, other.lock() as elsewhere:
            assert second is None and elsewhere is not None
        with point.lock() as third:  # a holder that was refused lets nothing go
            assert third is None
    with point.lock() as again:
        assert again is not None


def test_a_lock_is_given_back_after_an_error(point):
    with pytest.raises(RuntimeError), point.lock():
        raise RuntimeError
    with point.lock() as again:
        assert again is not None


def test_another_process_is_kept_out_too(point):
    script = (
        "import fcntl, sys\nfile = open(sys.argv[1], 'w')\n"
        "try: fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)\nexcept BlockingIOError: print('kept out')"
    )
    with point.lock():
        (lock,) = point.folder.parent.glob(".*")
        found = subprocess.run([sys.executable, "-S", "-c", script, str(lock)], capture_output=True, text=True)
        assert found.stdout == "kept out\n"
    found = subprocess.run([sys.executable, "-S", "-c", script, str(lock)], capture_output=True, text=True)
    assert found.stdout == ""


def test_a_child_that_inherited_the_lock_keeps_it_until_it_ends(point):
    with point.lock() as handle:
        child = subprocess.Popen(["sleep", "60"], pass_fds=(handle,))
    try:
        assert point.state()[0] == "running"
        with point.lock() as mine:
            assert mine is None
    finally:
        child.kill()
        child.wait()
    assert point.state()[0] == "waiting"
    with point.lock() as mine:
        assert mine is not None


def test_who_only_looks_at_the_state_does_not_keep_a_point_from_starting(point):
    """``suite status`` in another terminal touches the lock for a moment; a start at that moment must not be lost."""
    with point.lock():
        pass
    (lock,) = point.folder.parent.glob(".*")
    script = (
        "import fcntl, sys, time\nfile = open(sys.argv[1])\nfcntl.flock(file, fcntl.LOCK_SH)\n"
        "print('looks', flush=True)\nsys.stdin.readline()\ntime.sleep(0.02)"
    )
    with subprocess.Popen(
        [sys.executable, "-S", "-c", script, str(lock)], stdin=subprocess.PIPE, stdout=subprocess.PIPE
    ) as looker:
        assert looker.stdout.readline() == b"looks\n"
        looker.stdin.write(b"\n")
        looker.stdin.flush()
        with point.lock() as handle:
            assert handle is not None


def test_looking_at_the_state_never_says_running_to_another_who_looks(point):
    with point.lock():
        pass
    seen, stop = set(), time.monotonic() + 0.3

    def look():
        while time.monotonic() < stop:
            seen.add(point.state()[0])

    threads = [threading.Thread(target=look) for _ in range(3)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert seen == {"waiting"}


# states


def test_a_point_waits_until_something_is_there(point):
    assert point.state() == ("waiting", "")
    put(point)
    assert point.state() == ("waiting", "")
    point.folder.mkdir()
    assert point.state() == ("waiting", "")


def test_a_point_that_is_held_runs_and_its_phase_is_told(point):
    with point.lock():
        assert point.state() == ("running", "fit")
        train(point, "running", step=40)
        assert point.state() == ("running", "fit step 40")
        train(point, "finished", step=50)
        assert point.state() == ("running", "export")
        (point.folder / "bundle").mkdir()
        assert point.state() == ("running", "probe")
        put(point, error="of an earlier attempt", job="17")
        assert point.state()[0] == "running"


@pytest.mark.parametrize("state", ["preempted", "interrupted", "killed", "finished"])
def test_a_run_that_nobody_holds_is_stopped(point, state):
    train(point, "running" if state == "killed" else state, step=40)
    if state == "killed":
        path = point.folder / "status.json"
        path.write_text(path.read_text().replace(f'"process": {os.getpid()}', '"process": 999999999'))
    assert point.state() == ("stopped", "step 40")


def test_a_failed_point_tells_its_error_and_a_queued_one_its_job(point):
    put(point, job="17_3")
    assert point.state() == ("queued", "job 17_3")
    train(point, "preempted", step=40)
    assert point.state() == ("queued", "job 17_3")
    put(point, error="fit ended with exit code 1: no memory")
    assert point.state() == ("failed", "fit ended with exit code 1: no memory")


def test_a_finished_point_stays_finished(point):
    put(point, finished=True)
    assert point.state() == ("finished", "")
    train(point, "failed", step=3)
    put(point, finished=True, job="17")
    with point.lock():
        assert point.state() == ("finished", "")
