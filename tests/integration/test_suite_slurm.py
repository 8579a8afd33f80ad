"""``suite run --executor slurm`` through submitit, against imitations of SLURM's commands and of the three phases."""

from __future__ import annotations

import json
import os
import signal
import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parent))
import fake_phases
import fake_slurm
from fake_phases import calls, wait_until

pytest.importorskip("submitit")

from repdib_lightning.__main__ import main
from repdib_lightning.experiments import run as suite_run

SUITE = """
base: [robot_arm]
data: small.h5
seeds: [0]
threads: 3
slurm: {timeout_min: 30, mem_gb: 2, slurm_partition: long, slurm_array_parallelism: 7}
grids:
  g: {vary: {config: [bottleneck/none, bottleneck/vib]}}
"""
BOTH = ["fit", "export", "probe"] * 2


@pytest.fixture
def here(tmp_path, monkeypatch, store_file):
    """A folder with a store, a suite of two points, and imitations of the phases and of SLURM."""
    monkeypatch.chdir(tmp_path)
    Path("s.yaml").write_text(SUITE)
    Path("orders").mkdir()
    Path("calls.txt").touch()
    monkeypatch.setenv("PATH", f"{fake_slurm.install(tmp_path / 'slurm')}:{os.environ['PATH']}")
    monkeypatch.setattr(sys, "executable", fake_phases.install(tmp_path))
    monkeypatch.setattr(suite_run, "_LOOK_EVERY", 0.02)
    return tmp_path


def submit(*words: str) -> int:
    return main(["suite", "run", "s.yaml", "--executor", "slurm", *words])


def states(capsys) -> list[str]:
    """State, and what follows the seconds, of both points."""
    capsys.readouterr()
    assert main(["suite", "status", "s.yaml"]) == 0
    rows = [line.split() for line in capsys.readouterr().out.splitlines() if line.startswith("g/")]
    return [" ".join([row[2], *row[4:]]) for row in rows]


def record(setting: str, runs: str = "runs/suites") -> dict:
    return json.loads(Path(runs, f"s/g/{setting}/seed_0.json").read_text())


def queue() -> list[str]:
    return sorted(path.name for path in Path("slurm/queue").iterdir())


def test_points_finish_as_they_do_locally(here, capsys):
    assert main(["suite", "run", "s.yaml", "--runs", "local"]) == 0
    before = len(calls("begin"))
    assert submit() == 0
    assert "submitted 2" in capsys.readouterr().out
    wait_until(lambda: not queue(), "all jobs ended")
    assert sorted(line[1] for line in calls("begin")[before:]) == sorted(BOTH)
    assert states(capsys) == ["finished", "finished"]
    for setting in ("none", "vib"):
        queued, local = record(setting), record(setting, "local")
        assert queued.pop("seconds").keys() == local.pop("seconds").keys()
        assert queued == local and queued["finished"] and queued["threads"] == 3 and queued["job"] == ""

    script = Path("slurm/scripts/17").read_text()
    for line in ("partition=long", "time=30", "mem=2GB", "cpus-per-task=3", "array=0-1%2", "signal=USR2@90"):
        assert f"#SBATCH --{line}\n" in script, script
    assert submit() == 0
    assert "submitted 0" in capsys.readouterr().out and len(list(Path("slurm/scripts").iterdir())) == 1


@pytest.mark.parametrize(("words", "limit"), [([], 2), (["--jobs", "1"], 1)])
def test_jobs_limits_the_array(here, words, limit):
    Path("slurm/held").touch()
    assert submit(*words) == 0
    assert f"#SBATCH --array=0-1%{limit}\n" in Path("slurm/scripts/17").read_text()


def test_what_is_queued_is_not_submitted_again_and_what_was_cancelled_is(here, capsys):
    Path("slurm/held").touch()
    assert submit() == 0
    assert states(capsys) == ["queued job 17_0", "queued job 17_1"]
    assert submit() == 0
    assert "submitted 0" in capsys.readouterr().out and queue() == ["17_0", "17_1"]
    assert main(["suite", "run", "s.yaml"]) == 0, "nor run here"
    assert "2 queued of 2 points" in capsys.readouterr().out and not calls()

    Path("slurm/queue/17_1").unlink()  # scancel
    assert states(capsys) == ["queued job 17_0", "stopped job 17_1 is not in the queue"]
    Path("slurm/held").unlink()
    assert submit() == 0
    assert "submitted 1" in capsys.readouterr().out
    wait_until(lambda: queue() == ["17_0"], "the second job ended")
    assert states(capsys) == ["queued job 17_0", "finished"]
    assert [line[2] for line in calls("begin", "fit")] == ["vib-seed_0"]

    fake_slurm.release(Path("slurm").resolve(), ["17_0"])
    wait_until(lambda: not queue(), "the first job ended")
    assert states(capsys) == ["finished", "finished"] and len(calls("begin")) == len(BOTH)


def test_without_a_queue_points_that_were_queued_run_here(here, capsys, monkeypatch):
    Path("slurm/held").touch()
    assert submit() == 0
    monkeypatch.setenv("PATH", "/nowhere")
    assert main(["suite", "run", "s.yaml"]) == 0
    assert states(capsys) == ["finished", "finished"] and record("none")["job"] == ""


def test_a_failure_in_the_queue_is_seen_and_tried_again(here, capsys):
    broken = fake_phases.order("probe", Path("none/seed_0"))
    broken.write_text("fail")
    assert submit() == 0
    wait_until(lambda: not queue(), "all jobs ended")
    assert states(capsys) == ["failed probe ended with exit code 2: it broke", "finished"]
    broken.unlink()
    assert submit() == 0
    wait_until(lambda: not queue(), "the job ended")
    assert states(capsys) == ["finished", "finished"] and len(calls("begin", "fit")) == 2


def test_at_the_time_limit_a_job_saves_is_put_back_and_goes_on(here, capsys):
    waiting = fake_phases.order("fit", Path("none/seed_0"))
    waiting.write_text("wait")
    assert submit("--only", "none") == 0
    wait_until(lambda: calls("waits"), "fit waits")
    child = int(calls("waits")[0][2])
    parent = int(Path(f"/proc/{child}/stat").read_text().rpartition(")")[2].split()[1])
    assert submit() == 0, "only the point that is not running"
    assert "submitted 1" in capsys.readouterr().out

    Path("slurm/held").touch()
    for process in (child, parent):  # SLURM signals every process of a job
        os.kill(process, signal.SIGUSR2)
    wait_until(Path("slurm/requeued").exists, "it is put back")
    assert Path("slurm/requeued").read_text() == "17\n"
    wait_until(lambda: states(capsys)[0] == "queued job 17", "it is queued")
    assert submit() == 0
    assert "submitted 0" in capsys.readouterr().out
    Path("slurm/held").unlink()
    wait_until(lambda: len(calls("waits")) == 2, "it runs again")
    assert [line[2] for line in calls("signal")] == [str(int(signal.SIGTERM))]
    assert record("none")["job"] == "17" and record("none")["error"] == ""
    waiting.unlink()
    wait_until(lambda: not queue(), "all jobs ended")
    assert states(capsys) == ["finished", "finished"]
    assert [line[3] for line in calls("begin", "fit") if line[2] == "none-seed_0"] == ["new", "resume"]


def test_a_killed_job_can_be_submitted_again(here, capsys):
    waiting = fake_phases.order("fit", Path("none/seed_0"))
    waiting.write_text("wait")
    assert submit("--only", "none") == 0
    wait_until(lambda: calls("waits"), "fit waits")
    child = int(calls("waits")[0][2])
    parent = int(Path(f"/proc/{child}/stat").read_text().rpartition(")")[2].split()[1])
    for process in (parent, child):
        os.kill(process, signal.SIGKILL)
    wait_until(lambda: not queue(), "the job is gone")
    assert states(capsys)[0] == "stopped job 17 is not in the queue"
    waiting.unlink()
    assert submit("--only", "none") == 0
    wait_until(lambda: not queue(), "the job ended")
    assert states(capsys)[0] == "finished" and [line[3] for line in calls("begin", "fit")] == ["new", "resume"]


def test_redo_in_the_queue(here, capsys):
    assert main(["suite", "run", "s.yaml"]) == 0
    Path("slurm/held").touch()
    assert submit("--redo", "probe", "--only", "none") == 0
    assert states(capsys) == ["queued job 17", "finished"]
    assert submit("--redo", "probe", "--only", "none") == 0
    assert queue() == ["17"], "what is queued is not submitted again"
    Path("slurm/held").unlink()
    fake_slurm.release(Path("slurm").resolve(), ["17"])
    wait_until(lambda: not queue(), "the job ended")
    assert states(capsys) == ["finished", "finished"] and [line[1] for line in calls("begin")] == [*BOTH, "probe"]


@pytest.mark.parametrize(
    ("parameter", "wanted"),
    [
        ("slurm_partitio: x", "suite's slurm parameters: unknown 'slurm_partitio', did you mean 'slurm_partition'?"),
        ("partition: x", "suite's slurm parameters: unknown 'partition', did you mean 'slurm_partition'?"),
        ("timeout_min: long", 'suite\'s slurm parameters: Parameter "timeout_min" expected type'),
    ],
)
def test_a_bad_parameter(here, capsys, parameter, wanted):
    Path("s.yaml").write_text(SUITE.replace("timeout_min: 30", parameter))
    assert wanted in complaint(capsys)


def test_no_submitit(here, capsys, monkeypatch):
    monkeypatch.setitem(sys.modules, "submitit", None)
    assert complaint(capsys) == "error: --executor slurm needs submitit: pip install 'repdib_lightning[slurm]'"


@pytest.mark.parametrize("command", ["sbatch", "srun"])
def test_no_slurm(here, capsys, command):
    Path("slurm/bin", command).unlink()
    assert f"--executor slurm: no command '{command}' here" in complaint(capsys)


def test_slurm_refuses(here, capsys):
    Path("slurm/refuse").write_text("invalid partition specified: long")
    assert submit() == 2
    error = capsys.readouterr().err.splitlines()
    assert error[-1] == "error: sbatch did not take the jobs: sbatch: error: invalid partition specified: long"
    assert states(capsys) == ["waiting", "waiting"]


def test_slurm_does_not_answer(here, capsys):
    Path("slurm/held").touch()
    assert submit() == 0
    capsys.readouterr()
    Path("slurm/refuse").write_text("connection refused")
    assert submit() == 2
    assert "squeue ended with exit code 1: squeue: error: connection refused" in capsys.readouterr().err
    assert queue() == ["17_0", "17_1"]


def complaint(capsys) -> str:
    """One line, exit code 2, nothing written."""
    capsys.readouterr()
    assert submit() == 2
    said = capsys.readouterr()
    assert said.err.count("\n") == 1 and said.out == "", said
    assert not Path("runs").exists() and not queue()
    return said.err.strip()
