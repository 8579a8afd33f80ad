"""``suite run`` and ``suite status``: one point with the real commands, then what happens around them with fakes."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from importlib.metadata import version
from pathlib import Path

import pytest
import torch

sys.path.insert(0, str(Path(__file__).parent))
import fake_phases
from fake_phases import calls, wait_until

from repdib_lightning.__main__ import main
from repdib_lightning.callbacks import last_good, read_status
from repdib_lightning.data.episodes import EpisodeStore
from repdib_lightning.experiments import run as suite_run

REAL = """
base: [robot_arm, debug]
data: small.h5
seeds: [3]
grids:
  g:
    with: {data.batch_size: 4, data.horizon: 2, model.encoder.features: 16, trainer.max_steps: 6,
           trainer.val_check_interval: 3}
    vary: {config: [bottleneck/none]}
probe: {probes: linear}
"""
TWO = """
base: [robot_arm]
data: small.h5
seeds: [0, 1]
grids:
  g: {vary: {config: [bottleneck/none, bottleneck/vib]}}
"""
LAUNCH = """import signal, sys
signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell's background job, or nohup, ignores these two
signal.signal(signal.SIGHUP, signal.SIG_DFL)
sys.executable = sys.argv.pop(1)
from repdib_lightning.__main__ import main
from repdib_lightning.experiments import run
run._LOOK_EVERY = 0.02
sys.exit(main(sys.argv[1:]))"""


@pytest.fixture
def here(tmp_path, monkeypatch, store_file):
    """A folder with a store, a suite of four points, and fakes in the place of its commands."""
    monkeypatch.chdir(tmp_path)
    Path("two.yaml").write_text(TWO)
    Path("orders").mkdir()
    Path("calls.txt").touch()
    monkeypatch.setattr(sys, "executable", fake_phases.install(tmp_path))
    monkeypatch.setattr(suite_run, "_LOOK_EVERY", 0.02)
    return tmp_path


def suite(*words: str) -> int:
    return main(["suite", *words])


def point(name: str) -> Path:
    """``none-seed_0`` -> the run's folder."""
    setting, _, seed = name.partition("-")
    return Path("runs/suites/two/g") / setting / seed


def order(name: str, what: str, phase: str = "fit") -> Path:
    path = fake_phases.order(phase, point(name))
    path.write_text(what)
    return path


def record(name: str) -> dict:
    folder = point(name)
    return json.loads(folder.with_name(folder.name + ".json").read_text())


def states(capsys, *words: str) -> dict[str, str]:
    """What ``suite status`` says: point -> state and the word after its seconds."""
    capsys.readouterr()
    assert suite("status", "two.yaml", *words) == 0
    rows = [line.split() for line in capsys.readouterr().out.splitlines() if line.startswith("g/")]
    return {f"{row[0][2:]}-seed_{row[1]}": " ".join([row[2], *row[4:]]) for row in rows}


def start(*words: str) -> subprocess.Popen:
    """``suite run`` in a process of its own, the leader of its session."""
    command = [fake_phases.PYTHON, "-c", LAUNCH, sys.executable, "suite", "run", "two.yaml", *words]
    with open("suite.txt", "a") as output:
        return subprocess.Popen(command, stdout=output, stderr=output, start_new_session=True)


def killed_while_fitting(*, child_too: bool) -> int:
    """SIGKILL ``suite run`` while none-seed_0 is between two steps; returns the number of the process of its fit."""
    process = start("--only", "none", "--seeds", "0")
    wait_until(lambda: calls("waits"), "fit waits")
    process.kill()
    process.wait()
    child = int(calls("waits")[0][2])
    if child_too:
        os.kill(child, signal.SIGKILL)
    return child


# One point with the real commands.


def test_a_point_from_the_command_line(tmp_path, monkeypatch, store_file, capsys):
    monkeypatch.chdir(tmp_path)
    Path("real.yaml").write_text(REAL)
    assert suite("run", "real.yaml", "--jobs", "1") == 0
    assert "1 finished of 1 points" in capsys.readouterr().out
    folder = Path("runs/suites/real/g/none/seed_3")
    file, log = folder.with_name("seed_3.json"), folder.with_name("seed_3.log")

    text = file.read_text()
    assert text.endswith("}\n") and text.count("\n") == 1
    found = json.loads(text)
    assert found["finished"] and not found["error"] and not found["job"]
    assert found["configuration"]["seed_everything"] == 3 and found["configuration"]["trainer"]["max_steps"] == 6
    assert found["configuration"]["model"]["bottleneck"]["class_path"].endswith("Identity")
    assert found["versions"]["torch"] == version("torch")
    assert found["data"] == {"file": "small.h5", "fingerprint": EpisodeStore("small.h5").fingerprint}
    assert found["factors"] == {"cell": "state", "light": "noise"}
    assert set(found["seconds"]) == {"fit", "export", "probe"} and min(found["seconds"].values()) > 0

    probed = json.loads((folder / "probe.json").read_text())
    for factor, content in probed["factors"].items():
        assert found["metrics"][f"linear/{factor}/kept"] == content["probes"]["linear"]["kept"]
    assert found["metrics"]["linear/state/kept"] == probed["summary"]["endogenous"]["linear"]
    assert str(found["metrics"]["val/loss"]) in (folder / "metrics.csv").read_text().splitlines()[-1]

    written, logged = file.stat().st_mtime_ns, log.read_text()
    with monkeypatch.context() as patched:
        patched.setattr(subprocess, "Popen", None)
        assert suite("run", "real.yaml") == 0
    assert file.stat().st_mtime_ns == written and log.read_text() == logged
    capsys.readouterr()
    assert suite("status", "real.yaml") == 0
    assert "finished" in capsys.readouterr().out

    typed = next(line for line in logged.splitlines() if line.startswith("$ python -m repdib_lightning fit "))
    words = typed.replace(str(folder), "typed").split()[2:]
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "MKL_NUM_THREADS": "1"}
    subprocess.run([sys.executable, *words], check=True, env=environment)
    ours, theirs = (torch.load(last_good(run), weights_only=True)["state_dict"] for run in (folder, Path("typed")))
    assert ours.keys() == theirs.keys() and all(torch.equal(ours[name], theirs[name]) for name in ours)


# What happens around the commands, with fakes.


def test_a_failing_point_stops_no_other_and_is_alone_tried_again(here, capsys):
    broken = order("vib-seed_0", "fail")
    assert suite("run", "two.yaml", "--jobs", "2") == 1
    said = capsys.readouterr().out
    assert "3 finished, 1 failed of 4 points" in said
    assert "failed: g/vib seed 0: fit ended with exit code 2: it broke" in said
    shown = states(capsys)
    assert shown.pop("vib-seed_0") == "failed fit ended with exit code 2: it broke"
    assert set(shown.values()) == {"finished"}

    broken.unlink()
    before = len(calls("begin"))
    assert suite("run", "two.yaml", "--jobs", "2") == 0
    assert [line[1:3] for line in calls("begin")[before:]] == [[p, "vib-seed_0"] for p in ("fit", "export", "probe")]
    assert record("vib-seed_0")["finished"] and not record("vib-seed_0")["error"]


def test_a_probe_that_fails_is_tried_again_without_another_fit(here):
    broken = order("none-seed_0", "fail", "probe")
    assert suite("run", "two.yaml", "--only", "none", "--seeds", "0") == 1
    broken.unlink()
    assert suite("run", "two.yaml", "--only", "none", "--seeds", "0") == 0
    assert [line[1] for line in calls("begin")] == ["fit", "export", "probe", "probe"]


def test_a_measure_that_is_no_number_is_a_failure_of_its_point_alone(here, capsys):
    order("none-seed_0", "nan")
    assert suite("run", "two.yaml") == 1
    assert "3 finished, 1 failed" in capsys.readouterr().out
    assert states(capsys)["none-seed_0"] == "failed val/loss is nan"
    assert not record("none-seed_0")["finished"]


def test_a_killed_suite_goes_on_where_its_child_stopped(here, capsys):
    waiting = order("none-seed_0", "wait")
    killed_while_fitting(child_too=True)
    assert states(capsys, "--seeds", "0") == {"none-seed_0": "stopped step 3", "vib-seed_0": "waiting"}
    checkpoint = (point("none-seed_0") / "checkpoints/step-00000003.ckpt").read_text()
    waiting.unlink()
    assert suite("run", "two.yaml", "--only", "none", "--seeds", "0") == 0
    assert [line[3] for line in calls("begin", "fit")] == ["new", "resume"]
    assert (point("none-seed_0") / "checkpoints/step-00000003.ckpt").read_text() == checkpoint


def test_a_child_that_outlives_its_suite_keeps_its_point(here, capsys):
    waiting = order("none-seed_0", "wait")
    killed_while_fitting(child_too=False)
    assert suite("run", "two.yaml", "--seeds", "0") == 0
    assert "1 finished, 1 running of 2 points" in capsys.readouterr().out
    assert states(capsys, "--seeds", "0")["none-seed_0"].startswith("running fit")
    waiting.unlink()
    wait_until(lambda: calls("end", "fit", "none-seed_0"), "fit ends")
    wait_until(lambda: not states(capsys)["none-seed_0"].startswith("running"), "the lock is free")
    assert suite("run", "two.yaml", "--seeds", "0") == 0
    assert [line[1] for line in calls("begin") if line[2] == "none-seed_0"] == ["fit", "export", "probe"]
    assert record("none-seed_0")["finished"]


def test_a_run_without_checkpoint_is_started_anew(here):
    waiting = order("none-seed_0", "wait before checkpoint")
    killed_while_fitting(child_too=True)
    assert point("none-seed_0").is_dir()
    waiting.unlink()
    assert suite("run", "two.yaml", "--only", "none", "--seeds", "0") == 0
    assert [line[3] for line in calls("begin", "fit")] == ["new", "new"]


def test_a_fit_killed_after_its_last_step_is_finished(here, capsys):
    order("none-seed_0", "die at the end")
    assert suite("run", "two.yaml", "--only", "none", "--seeds", "0") == 1
    assert "failed: g/none seed 0: fit ended with exit code -9" in capsys.readouterr().out
    assert suite("run", "two.yaml", "--only", "none", "--seeds", "0") == 0
    assert record("none-seed_0")["finished"]


@pytest.mark.parametrize(("phase", "again"), [("probe", ["probe"]), ("export", ["export", "probe"])])
def test_redo_repeats_a_phase_and_what_follows_it(here, phase, again):
    assert suite("run", "two.yaml", "--only", "none") == 0
    checkpoint = point("none-seed_0") / "checkpoints/step-00000003.ckpt"
    trained, bundle = checkpoint.stat(), point("none-seed_0") / "bundle/config.json"
    exported, before, metrics = bundle.stat(), len(calls("begin")), record("none-seed_0")["metrics"]
    assert suite("run", "two.yaml", "--only", "none", "--seeds", "0", "--redo", phase) == 0
    assert [line[1:3] for line in calls("begin")[before:]] == [[name, "none-seed_0"] for name in again]
    assert checkpoint.stat() == trained
    assert (bundle.stat().st_mtime_ns == exported.st_mtime_ns) == (phase == "probe")
    assert record("none-seed_0")["finished"] and record("none-seed_0")["metrics"] == metrics


def test_redo_fit_begins_a_new_run(here):
    assert suite("run", "two.yaml", "--only", "none") == 0
    checkpoint = point("none-seed_0") / "checkpoints/step-00000003.ckpt"
    trained = checkpoint.read_text()
    assert suite("run", "two.yaml", "--only", "none", "--redo", "fit") == 0
    assert checkpoint.read_text() != trained
    assert [line[3] for line in calls("begin", "fit")] == ["new"] * 4


def test_what_is_to_be_redone_stays_so_when_it_is_stopped(here):
    assert suite("run", "two.yaml") == 0
    broken = [order(f"{setting}-seed_{seed}", "fail", "probe") for setting in ("none", "vib") for seed in (0, 1)]
    assert suite("run", "two.yaml", "--redo", "probe") == 1
    for path in broken:
        path.unlink()
    assert suite("run", "two.yaml") == 0
    assert len(calls("begin", "fit")) == 4 and len(calls("begin", "probe")) == 12


def test_never_more_than_jobs_at_a_time(here):
    waiting = [order(f"{setting}-seed_{seed}", "wait") for setting in ("none", "vib") for seed in (0, 1)]
    process = start("--jobs", "2")
    wait_until(lambda: len(calls("waits")) == 2, "two wait")
    time.sleep(0.3)  # in which a third could begin
    assert len(calls("begin", "fit")) == 2
    for path in waiting:
        path.unlink()
    assert process.wait() == 0
    running, most = 0, 0
    for line in calls():
        running += {"begin": 1, "end": -1}.get(line[0], 0) if line[1] == "fit" else 0
        most = max(most, running)
    assert most == 2 and len(calls("end", "fit")) == 4


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT, signal.SIGHUP])
def test_a_stopped_suite_stops_its_children_and_can_go_on(here, capsys, number):
    waiting = [order(f"{setting}-seed_0", "wait") for setting in ("none", "vib")]
    process = start("--jobs", "2")
    wait_until(lambda: len(calls("waits")) == 2, "two wait")
    os.killpg(process.pid, number)  # as a terminal does, to the whole group
    assert process.wait() == 128 + number
    assert "stopping: what runs saves a checkpoint" in Path("suite.txt").read_text()
    assert [line[2] for line in calls("signal")] == [str(int(signal.SIGTERM))] * 2, "fit saves on SIGTERM alone"
    assert len(calls("begin")) == 2, "nothing else began"
    stopped, unbegun = {"stopped step 3"}, {"waiting"}
    shown = states(capsys)
    assert {shown["none-seed_0"], shown["vib-seed_0"]} == stopped
    assert {shown["none-seed_1"], shown["vib-seed_1"]} == unbegun
    assert read_status(point("vib-seed_0")).state == "preempted"
    for path in waiting:
        path.unlink()
    assert suite("run", "two.yaml") == 0
    assert sorted(line[3] for line in calls("begin", "fit")) == ["new"] * 4 + ["resume"] * 2


def test_settings_that_share_a_run_are_found_under_either_name(here):
    shared = TWO.replace("grids:", "grids:\n  h: {vary: {config: [bottleneck/none]}}")
    Path("two.yaml").write_text(shared)
    assert suite("run", "two.yaml", "--only", "g/none,vib", "--seeds", "0,0") == 0
    assert sorted(line[2] for line in calls("begin", "fit")) == ["none-seed_0", "vib-seed_0"]
    assert Path("runs/suites/two/h/none/seed_0.json").is_file()


@pytest.mark.parametrize(
    ("words", "wanted"),
    [
        (["--executor", "slrum"], "--executor: unknown 'slrum', did you mean 'slurm'?"),
        (["--jobs", "0"], "--jobs must be at least 1, is 0"),
        (["--jobs", "many"], "jobs: expected int, got 'many'"),
        (["--only", "non"], "--only: no setting or grid is called 'non', did you mean 'none'?"),
        (["--only", ","], "--only: expected a word"),
        (["--seeds", "0", "--tune"], "--seeds: seed 0 is for reporting only"),
        (["--seeds", "100"], "--seeds: seed 100 is for development"),
        (["--seeds=-1"], "--seeds: must be at least 0, is -1"),
        (["--seeds", "one"], "--seeds: expected numbers between commas, got 'one'"),
        (["--redo", "prob"], "--redo: no phase is called 'prob', did you mean 'probe'?"),
        (["--redoo", "probe"], "unknown option --redoo, did you mean '--redo'?"),
    ],
)
def test_bad_options(here, capsys, words, wanted):
    complaint(capsys, ["run", "two.yaml", *words], wanted)


def test_an_unknown_suite_and_a_missing_store(here, capsys):
    complaint(capsys, ["run", "tow.yaml"], "suite tow.yaml: no such file or packaged suite")
    complaint(capsys, ["status", "robot_amr"], "did you mean 'robot_arm'?")
    complaint(capsys, ["rum", "two.yaml"], "unknown verb 'rum', did you mean 'run'?")
    Path("small.h5").unlink()
    complaint(capsys, ["run", "two.yaml"], "small.h5")


def complaint(capsys, words: list[str], wanted: str) -> None:
    """One line, exit code 2, nothing written and nothing started."""
    capsys.readouterr()
    assert suite(*words) == 2
    said = capsys.readouterr()
    assert said.err.count("\n") == 1 and wanted in said.err and said.out == "", said
    assert not Path("runs").exists() and not calls()
