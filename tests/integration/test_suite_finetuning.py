"""``suite run`` with fine-tunings after the probe, or alone; all commands are imitations."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parent))
import fake_phases
from fake_phases import calls, wait_until
from test_suite_runs import LAUNCH

from repdib_lightning.__main__ import main
from repdib_lightning.data.episodes import EpisodeStore
from repdib_lightning.experiments import run as suite_run

SUITE = """
base: [robot_arm]
data: small.h5
seeds: [0, 1]
finetune:
  agent: dqn
  with: {steps: 200, learning_starts: 100, env_options.goals: none}
  runs:
    Spiral: {env: SpiralWorld}
    Loop: {env: LoopWorld, steps: 300}
grids:
  g:
    settings:
      none: {config: bottleneck/none}
      scratch: {pretrained: false}
"""


@pytest.fixture
def here(tmp_path, monkeypatch, store_file):
    monkeypatch.chdir(tmp_path)
    Path("m.yaml").write_text(SUITE)
    Path("orders").mkdir()
    Path("calls.txt").touch()
    monkeypatch.setattr(sys, "executable", fake_phases.install(tmp_path))
    monkeypatch.setattr(suite_run, "_LOOK_EVERY", 0.02)
    return tmp_path


def run(*words: str) -> int:
    return main(["suite", "run", "m.yaml", "--jobs", "1", *words])


def folder(setting: str, seed: int = 0) -> Path:
    return Path(f"runs/suites/m/g/{setting}/seed_{seed}")


def record(setting: str, seed: int = 0) -> dict:
    return json.loads(folder(setting, seed).with_suffix(".json").read_text())


def order(setting: str, what: str) -> Path:
    path = fake_phases.order("finetune", folder(setting))
    path.write_text(what)
    return path


def begun(before: int = 0) -> list[str]:
    """``fit``, ``finetune Spiral`` and so on, in order."""
    return [f"{line[1]} {line[3]}" if line[1] == "finetune" else line[1] for line in calls("begin")[before:]]


def state(capsys, setting: str) -> str:
    capsys.readouterr()
    assert main(["suite", "status", "m.yaml", "--only", setting, "--seeds", "0"]) == 0
    (row,) = [line.split() for line in capsys.readouterr().out.splitlines() if line.startswith("g/")]
    return " ".join([row[2], *row[4:]])


def test_fine_tunings_follow_the_probe_and_their_measures_are_recorded(here, capsys):
    assert run("--only", "none") == 0
    assert begun() == ["fit", "export", "probe", "finetune Spiral", "finetune Loop"] * 2
    found = record("none", 1)
    assert found["metrics"]["dqn/Spiral/success"] == found["metrics"]["dqn/Loop/success"] == 0.6
    assert "dqn/Spiral/steps_to_solve" not in found["metrics"], "null: it never was"
    assert found["metrics"]["linear/cell/kept"] == 0.6 and found["data"]["file"] == "small.h5"
    used = found["configuration"]["finetune"]
    assert used["Spiral"]["--steps"] == "200" and used["Loop"]["--steps"] == "300"
    assert used["Loop"]["--env_options.goals"] == "none" and used["Loop"]["--seed"] == "1"
    assert used["Spiral"]["--encoder"] == str(folder("none", 1) / "bundle")
    assert set(found["seconds"]) == {"fit", "export", "probe", "finetune"}
    assert state(capsys, "none") == "finished"


def test_from_scratch_there_is_nothing_but_fine_tuning_and_no_data_is_needed(here):
    Path("small.h5").unlink()
    assert run("--only", "scratch", "--seeds", "0") == 0
    assert begun() == ["finetune Spiral", "finetune Loop"] and calls("begin")[0][4] == "scratch"
    found = record("scratch")
    assert found["metrics"] == {"dqn/Spiral/success": 0.5, "dqn/Loop/success": 0.5}
    assert found["data"] == {} and found["versions"] == {"python": "3"} and found["arguments"] == []
    assert "--encoder" not in found["configuration"]["finetune"]["Loop"]
    assert [path.name for path in folder("scratch").iterdir()] == ["finetune"]


@pytest.mark.parametrize(("setting", "earlier"), [("none", 3), ("scratch", 0)])
def test_a_failed_fine_tuning_alone_is_tried_again(here, capsys, setting, earlier):
    broken = order(setting, "fail Loop")
    assert run("--only", setting, "--seeds", "0") == 1
    assert state(capsys, setting) == "failed finetune Loop ended with exit code 2: it broke"
    assert begun()[earlier:] == ["finetune Spiral", "finetune Loop"]
    broken.unlink()
    assert run("--only", setting, "--seeds", "0") == 0
    assert begun()[earlier + 2 :] == ["finetune Loop"]


@pytest.mark.parametrize(("setting", "earlier"), [("none", 3), ("scratch", 0)])
def test_a_stopped_fine_tuning_is_begun_anew_and_the_ones_before_are_kept(here, capsys, setting, earlier):
    waiting = order(setting, "wait Loop")
    command = [fake_phases.PYTHON, "-c", LAUNCH, sys.executable, "suite", "run", "m.yaml"]
    with open("said.txt", "a") as output:
        process = subprocess.Popen(
            [*command, "--only", setting, "--seeds", "0"], stdout=output, stderr=output, start_new_session=True
        )
    wait_until(lambda: calls("waits"), "the second one waits")
    assert state(capsys, setting) == "running finetune Loop"
    process.send_signal(signal.SIGTERM)
    assert process.wait() == 128 + signal.SIGTERM
    assert [line[2] for line in calls("signal")] == [str(int(signal.SIGTERM))]
    assert state(capsys, setting) == "stopped finetune Loop"
    assert (folder(setting) / "finetune/Loop/progress.csv").is_file()
    kept = (folder(setting) / "finetune/Spiral/outcome.json").stat().st_mtime_ns
    waiting.unlink()
    before = len(calls("begin"))
    assert run("--only", setting, "--seeds", "0") == 0
    assert begun(before) == ["finetune Loop"] and before == earlier + 2
    assert (folder(setting) / "finetune/Spiral/outcome.json").stat().st_mtime_ns == kept


@pytest.mark.parametrize(
    ("phase", "none", "scratch"),
    [
        ("finetune", ["finetune Spiral", "finetune Loop"], ["finetune Spiral", "finetune Loop"]),
        ("probe", ["probe"], []),
        ("export", ["export", "probe", "finetune Spiral", "finetune Loop"], []),
    ],
)
def test_redo_repeats_what_depends_on_a_phase_where_there_is_one(here, phase, none, scratch):
    assert run("--seeds", "0") == 0
    before = len(calls("begin"))
    assert run("--seeds", "0", "--redo", phase) == 0
    assert begun(before) == [*none, *scratch]
    assert record("none")["finished"] and record("scratch")["finished"]


def test_a_fine_tuning_that_is_added_later_is_the_only_one_that_runs(here, capsys):
    Path("m.yaml").write_text(SUITE.replace("    Loop: {env: LoopWorld, steps: 300}\n", ""))
    assert run("--seeds", "0") == 0
    Path("m.yaml").write_text(SUITE)
    assert state(capsys, "none") == state(capsys, "scratch") == "stopped finetune Loop"
    before = len(calls("begin"))
    assert run("--seeds", "0") == 0
    assert begun(before) == ["finetune Loop"] * 2
    assert {"dqn/Spiral/success", "dqn/Loop/success"} <= set(record("none")["metrics"])


def test_a_fine_tuning_with_other_options_is_refused_until_it_is_removed(here, capsys):
    assert run("--only", "scratch", "--seeds", "0") == 0
    Path("m.yaml").write_text(SUITE.replace("steps: 300", "steps: 400"))
    capsys.readouterr()
    assert run("--only", "scratch", "--seeds", "0") == 2
    said = capsys.readouterr().err
    place = folder("scratch") / "finetune/Loop"
    assert said.count("\n") == 1 and f"{place}: was run with other options (--steps 300 then, --steps 400 now)" in said
    for path in place.iterdir():
        path.unlink()
    place.rmdir()
    before = len(calls("begin"))
    assert run("--only", "scratch", "--seeds", "0") == 0
    assert begun(before) == ["finetune Loop"]
    assert record("scratch")["configuration"]["finetune"]["Loop"]["--steps"] == "400"


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("steps: 300", "steps: -5", "finetune run 'Loop' of g/none: --steps must be at least 1, is -5"),
        ("steps: 300", "steps: many", "finetune run 'Loop' of g/none: steps: expected int, got 'many'"),
        ("env: LoopWorld", "env: LopWorld", "run 'Loop' of g/none: --env LopWorld: no such environment, did you mean"),
        ("goals: none", "goals: '6,2'", "finetune run 'Spiral' of g/none: --env SpiralWorld: goals=6,2: lies outside"),
        ("goals: none", "gols: none", "run 'Spiral' of g/none: --env_options.gols: no option of SpiralWorld, did you"),
        ("steps: 300", "frozen: maybe", "finetune run 'Loop' of g/none: frozen: expected bool, got 'maybe'"),
        (
            "steps: 300",
            "strides: [9, 9, 9]",
            "finetune run 'Loop' of g/scratch: ConvolutionalEncoder: 'picture' of 30x30",
        ),
        ("steps: 300", "device: gpu", "finetune run 'Loop' of g/none: --device gpu: there is no such device"),
    ],
)
def test_a_bad_value_is_told_before_anything_is_collected_or_trained(here, capsys, old, new, said):
    assert old in SUITE
    Path("m.yaml").write_text(SUITE.replace(old, new).replace("small.h5", "absent.h5\ncollect: maze --samples 100"))
    assert run() == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1 and error.startswith("error: m.yaml: ") and said in error
    assert not Path("absent.h5").exists() and not calls("begin")


def test_a_device_of_another_machine_may_be_asked_for(here, monkeypatch):
    monkeypatch.setattr("torch.cuda.is_available", lambda: False)
    Path("m.yaml").write_text(SUITE.replace("steps: 300", "device: cuda"))
    assert run("--only", "none", "--seeds", "0") == 0


def test_a_suite_without_fine_tuning_has_none_to_redo(here, capsys):
    Path("m.yaml").write_text("base: robot_arm\ndata: small.h5\ngrids: {g: {vary: {config: [bottleneck/none]}}}\n")
    assert run("--redo", "finetune") == 2
    assert "--redo: no phase is called 'finetune'" in capsys.readouterr().err


def test_each_grid_trains_and_probes_on_its_own_data(here, store_file):
    Path("noisy.h5").write_bytes(store_file.read_bytes())
    grids = "grids:\n  noisy: {data: noisy.h5, settings: {none: {config: bottleneck/none}}}"
    Path("m.yaml").write_text(SUITE.replace("grids:", grids))
    assert run("--only", "none", "--seeds", "0") == 0
    for grid, store in (("noisy", "noisy.h5"), ("g", "small.h5")):
        log = Path(f"runs/suites/m/{grid}/none/seed_0.log").read_text()
        assert f"--data.path {store}" in log and f"probe runs/suites/m/{grid}/none/seed_0 {store}" in log


# explorations, and their snapshots

EXPLORE = """
data: {class_path: ExplorationDataModule, init_args: {task: walker-stand, frames: 40000}}
model: {bottleneck: {class_path: Identity}}
"""
EXPLORING = """
base: explore.yaml
data: small.h5
seeds: [0, 1]
finetune:
  agent: ddpg
  with: {frames: 20000, features: 64}
  snapshots: [5000, 10000]
  runs:
    walk: {task: walker-walk}
grids:
  g:
    with: {data.snapshots: [5000, 10000, 20000]}
    settings:
      none: {}
      scratch: {pretrained: false}
"""


@pytest.fixture
def exploring(here):
    Path("explore.yaml").write_text(EXPLORE)
    Path("m.yaml").write_text(EXPLORING)
    return here


def test_an_exploration_is_fine_tuned_from_each_snapshot_and_has_data_of_its_own(exploring, capsys):
    assert run("--only", "none", "--seeds", "1") == 0
    assert begun() == ["fit", "export", "probe", "finetune walk_5000", "finetune walk_10000"]
    assert {line[4] for line in calls("begin", "finetune")} == {str(folder("none", 1))}, "the run, which has snapshots"
    found = record("none", 1)
    assert "--data.path" not in found["arguments"] and found["arguments"][-2:] == ["--data.seed", "1"]
    assert found["metrics"]["ddpg/walk_5000/return"] == 501.0 and found["metrics"]["ddpg/walk_10000/return"] == 1001.0
    assert found["metrics"]["explore/coverage"] == 60.0 and "explore/loss" not in found["metrics"]
    replay = EpisodeStore(folder("none", 1) / "replay.h5")
    assert found["data"] == {"file": "replay.h5", "fingerprint": replay.fingerprint} and replay.fingerprint
    assert found["probed"] == {"file": "small.h5", "fingerprint": "probed"}
    used = found["configuration"]["finetune"]["walk_5000"]
    assert used["--snapshot"] == "5000" and "--features" not in used
    assert state(capsys, "none") == "waiting" and record("none", 1)["finished"]


def test_from_scratch_there_are_no_snapshots(exploring):
    assert run("--only", "scratch", "--seeds", "0") == 0
    assert begun() == ["finetune walk"] and calls("begin")[0][4] == "scratch"
    assert record("scratch")["configuration"]["finetune"]["walk"]["--features"] == "64"
    assert record("scratch")["metrics"]["ddpg/walk/return"] == 0.0 and "probed" not in record("scratch")


def test_a_snapshot_that_is_added_later_is_the_only_one_that_is_fine_tuned_from(exploring, capsys):
    assert run("--only", "none", "--seeds", "0") == 0
    Path("m.yaml").write_text(EXPLORING.replace("[5000, 10000]\n", "[5000, 10000, 20000]\n"))
    before = len(calls("begin"))
    assert state(capsys, "none") == "stopped finetune walk_20000"
    assert run("--only", "none", "--seeds", "0") == 0
    assert begun(before) == ["finetune walk_20000"]


def test_the_report_of_explorations_holds_the_snapshots_against_each_other_and_scratch(exploring, capsys):
    assert run() == 0
    for setting, name in (("none", "walk_5000"), ("none", "walk_10000"), ("scratch", "walk")):
        for seed in (0, 1):
            path = folder(setting, seed) / "finetune" / name / "progress.csv"
            path.write_text("step,eval/return\n0,1\n20000,2\n")
    for path in Path("runs").rglob("probe.json"):
        assert json.loads(path.read_text())["codebook"] is None
    capsys.readouterr()
    Path("m.yaml").write_text(f"{EXPLORING}finetune_curves: [eval/return]\nmeasures: [ddpg/walk/monotone]\n")
    assert main(["suite", "report", "m.yaml"]) == 0
    said = Path("results/m/report.md").read_text()
    assert "each exploration on a replay of its own and probed on small.h5 (fingerprint probed)" in said
    assert "| walk: return at the end, after 10,000 frames | 1000.5 [1000.0, 1001.0] | - |" in said
    assert "| walk: return at the end, from scratch | - | 0.5 [0.0, 1.0] |" in said
    assert "| walk: rank correlation | 1.00 [1.00, 1.00] | - |" in said
    assert Path("results/m/g-snapshots-walk-eval-return.png").is_file()
