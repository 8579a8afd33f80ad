"""What was stopped goes on as though it had never stopped, to the last bit; what cannot go on is told."""

from __future__ import annotations

import json
import os
import shutil
import signal

import pytest
import torch
from safetensors.torch import load_file
from small_choices import FRESH, SMALL, choices_bundle, record_choices, register_choices

from repdib_lightning.errors import UserError
from repdib_lightning.rl.decision_transformer.module import DecisionTransformerModule
from repdib_lightning.rl.decision_transformer.training import DTTraining
from repdib_lightning.rl.finetune_dt import finetune_dt

CHOSEN = {"epochs": 3, "dropout": 0.2, "steps_per_epoch": 4, "evaluate_every": 2}
KINDS = {"latents": {}, "codes": {"codes": True}, "end to end": FRESH}


class Killed(BaseException):
    """Ends a process at once."""


@pytest.fixture(scope="module")
def world(tmp_path_factory):
    """Data, a bundle, and an uninterrupted run of each kind."""
    folder = tmp_path_factory.mktemp("resume")
    record_choices(folder / "d.h5", 30)
    choices_bundle(folder / "b", quantised=True)
    for kind in KINDS:
        begun(folder, folder / kind, kind)
    return folder


def begun(world, run, kind="latents", **changes):
    given = {**SMALL, **CHOSEN, **KINDS[kind], "data": world / "d.h5", "env": register_choices(), "run": run}
    return finetune_dt(**{**given, **({} if kind == "end to end" else {"encoder": world / "b"}), **changes})


def written(run):
    """All that a run leaves that is no date, place or log."""
    outcome = json.loads((run / "outcome.json").read_text())
    tensors = load_file(run / "policy.safetensors")
    bundle = load_file(run / "bundle" / "model.safetensors") if (run / "bundle").is_dir() else {}
    return outcome["measures"], (run / "progress.csv").read_text(), {**tensors, **bundle}


def assert_same(run, other):
    (measures, progress, tensors), (wanted, table, weights) = written(run), written(other)
    assert measures == wanted and progress == table and tensors.keys() == weights.keys()
    for name, value in tensors.items():
        assert torch.equal(value, weights[name]), name


def dies_in_update(monkeypatch, number, how):
    """Kill the process in an update, counted from 1 in this process."""
    plain, count = DecisionTransformerModule.training_step, [0]

    def step(self, batch, index):
        count[0] += 1
        if count[0] == number:
            how()
        plain(self, batch, index)

    monkeypatch.setattr(DecisionTransformerModule, "training_step", step)


def kill():
    raise Killed


@pytest.mark.parametrize(("kind", "update"), [("latents", 7), ("latents", 9), ("codes", 9), ("end to end", 7)])
def test_a_killed_training_goes_on_bit_for_bit(world, tmp_path, monkeypatch, kind, update):
    run = tmp_path / "r"
    with monkeypatch.context() as patched, pytest.raises(Killed):
        dies_in_update(patched, update, kill)
        begun(world, run, kind)
    there = sorted(path.name for path in (run / "checkpoints").iterdir())
    assert there == ["step-00000004.ckpt", "step-00000008.ckpt"][: (update - 1) // 4]
    assert not (run / "outcome.json").exists()
    begun(world, run, kind, resume=True)
    assert_same(run, world / kind)
    assert len(list((run / "checkpoints").iterdir())) == 3


@pytest.mark.parametrize("evaluation", [1, 2])
def test_one_that_is_killed_while_it_is_evaluated_goes_on_with_that(world, tmp_path, monkeypatch, evaluation):
    run, plain, count = tmp_path / "r", DTTraining._evaluate, [0]

    def evaluate(self, last):
        count[0] += 1
        if count[0] == evaluation:
            raise Killed
        return plain(self, last)

    with monkeypatch.context() as patched, pytest.raises(Killed):
        patched.setattr(DTTraining, "_evaluate", evaluate)
        begun(world, run)
    assert (run / "checkpoints" / f"step-{(8, 12)[evaluation - 1]:08d}.ckpt").is_file()
    updates = []
    with monkeypatch.context() as patched:
        dies_in_update(patched, -1, kill)
        step = DecisionTransformerModule.training_step
        patched.setattr(
            DecisionTransformerModule, "training_step", lambda s, b, i: (updates.append(i), step(s, b, i))[1]
        )
        begun(world, run, resume=True)
    assert len(updates) == (4, 0)[evaluation - 1]
    assert_same(run, world / "latents")


def test_one_that_is_preempted_loses_no_update(world, tmp_path, monkeypatch):
    run = tmp_path / "r"
    with monkeypatch.context() as patched, pytest.raises(SystemExit) as ended:
        dies_in_update(patched, 6, lambda: os.kill(os.getpid(), signal.SIGTERM))
        begun(world, run)
    assert ended.value.code == 143
    there = sorted(path.name for path in (run / "checkpoints").iterdir())
    assert there == ["step-00000004.ckpt", "step-00000006.ckpt"]
    begun(world, run, resume=True)
    assert_same(run, world / "latents")
    assert sorted(path.name for path in (run / "checkpoints").iterdir()) == [
        f"step-{step:08d}.ckpt" for step in (4, 8, 12)
    ]


def test_one_that_never_came_to_a_checkpoint_begins_anew(world, tmp_path, monkeypatch):
    run = tmp_path / "r"
    with monkeypatch.context() as patched, pytest.raises(Killed):
        dies_in_update(patched, 1, kill)
        begun(world, run)
    made = (run / "latents.h5").stat()
    begun(world, run, resume=True)
    assert_same(run, world / "latents")
    assert (run / "latents.h5").stat().st_mtime_ns == made.st_mtime_ns  # no frame is encoded twice


def test_a_damaged_checkpoint_is_passed_over(world, tmp_path, capsys):
    run = shutil.copytree(world / "latents", tmp_path / "r")
    (run / "outcome.json").unlink()
    content = bytearray((run / "checkpoints" / "step-00000012.ckpt").read_bytes())
    content[len(content) // 2] ^= 1
    (run / "checkpoints" / "step-00000012.ckpt").write_bytes(content)
    begun(world, run, resume=True)
    assert "damaged checkpoint passed over" in capsys.readouterr().err
    assert_same(run, world / "latents")


def test_checkpoints_hold_tensors_and_primitives_only(world):
    state = torch.load(world / "end to end" / "checkpoints" / "step-00000012.ckpt", weights_only=True)
    assert state["number"] == 12 and len(state["rows"]) == 2
    assert any(name.startswith("encoder.") for name in state["weights"])
    final = load_file(world / "end to end" / "policy.safetensors")
    assert all(torch.equal(state["weights"][f"network.{name}"], value) for name, value in final.items())


def test_a_finished_run_is_told_again(world, tmp_path):
    run = shutil.copytree(world / "latents", tmp_path / "r")
    before = {path: path.stat().st_mtime_ns for path in run.rglob("*")}
    told = begun(world, run, resume=True)
    assert told.endswith(f"was finished: {run}") and told.startswith("return ")
    assert {path: path.stat().st_mtime_ns for path in run.rglob("*")} == before


@pytest.fixture
def unfinished(world, tmp_path):
    run = shutil.copytree(world / "latents", tmp_path / "r")
    (run / "outcome.json").unlink()
    return run


def refused(*arguments, **changes):
    with pytest.raises(UserError) as caught:
        begun(*arguments, **changes)
    return str(caught.value)


def test_a_run_keeps_its_options(world, unfinished):
    told = refused(world, unfinished, resume=True, learning_rate=0.5)
    assert told == (
        f"--resume: --learning_rate was 0.0006 in {unfinished} and is 0.5 now; a run keeps its options, start a new "
        "one with another --run"
    )
    assert "was begun with --encoder" in refused(world, unfinished, "end to end", resume=True, channels=None,
                                                 kernels=None, strides=None, frame_stack=None)  # fmt: skip


def test_a_run_keeps_its_data_and_encoder(world, unfinished, tmp_path):
    other = record_choices(tmp_path / "other.h5", 30, seed=1)
    told = refused(world, unfinished, resume=True, data=other)
    assert told == f"--resume {unfinished}: --data holds other data than the run was started on (fingerprint)"
    bundle = choices_bundle(tmp_path / "other", quantised=True, stack=2)
    told = refused(world, unfinished, resume=True, encoder=bundle)
    assert told.startswith("--resume: --encoder is another than ")
    moved = shutil.copy(world / "d.h5", tmp_path / "moved.h5")
    assert "wrote" in begun(world, unfinished, resume=True, data=tmp_path / moved)


def test_what_cannot_go_on_is_told(world, unfinished, tmp_path):
    assert refused(world, None, resume=True) == "--resume needs --run FOLDER, the run to go on with"
    told = refused(world, unfinished, resume=True, overwrite=True)
    assert told == "--resume goes on with a run, --overwrite replaces it; leave one of them out"
    told = refused(world, tmp_path / "rr", resume=True)
    assert (
        told
        == f"--resume: {tmp_path / 'rr'} is no run of finetune, did you mean '{unfinished}'? (choices: {unfinished})"
    )
    told = refused(world, unfinished)
    assert told == (
        f"--run {unfinished}: exists already, unfinished; go on with it by --resume, choose another folder or pass "
        "--overwrite"
    )
    (unfinished / "finetune.json").write_text(json.dumps({"agent": "td3bc"}))
    told = refused(world, unfinished, resume=True)
    assert told == f"--resume: {unfinished} is a run of finetune td3bc, which begins anew with --overwrite"
