"""``finetune dt`` as a user calls it: what it learns, what it writes, and what it says of bad input."""

from __future__ import annotations

import csv
import json

import h5py
import numpy as np
import pytest
import torch
from lightning.pytorch import LightningModule
from offline_stores import register_quadrants, write_offline
from small_choices import (
    ACTIONS,
    FRESH,
    SMALL,
    STEPS,
    Choices,
    choices_bundle,
    random_store,
    record_choices,
    register_choices,
)

from repdib_lightning.__main__ import main
from repdib_lightning.errors import UserError
from repdib_lightning.export.load import load_encoder
from repdib_lightning.rl import AGENTS, CHECKS
from repdib_lightning.rl import outcome as outcomes
from repdib_lightning.rl.decision_transformer.module import DecisionTransformerModule, schedule
from repdib_lightning.rl.finetune_dt import check_dt, finetune_dt

LEARNING = {
    "epochs": 6, "context": 3, "layers": 2, "heads": 2, "width": 32, "batch_size": 32, "learning_rate": 1e-2,
    "dropout": 0.0, "warmup_tokens": 300, "episodes": 20, "evaluate_every": 9, "temperature": 0.0,
}  # fmt: skip


@pytest.fixture(scope="module")
def world(tmp_path_factory):
    folder = tmp_path_factory.mktemp("dt")
    record_choices(folder / "d.h5", 120)
    choices_bundle(folder / "b", quantised=True)
    choices_bundle(folder / "plain")
    return folder


def outcome(run):
    return json.loads((run / "outcome.json").read_text())


def trained(world, run, **changes):
    given = {**SMALL, "data": world / "d.h5", "encoder": world / "b", "env": register_choices(), "run": run}
    return finetune_dt(**{**given, **changes})


@pytest.mark.parametrize(
    "kind", [{"encoder": "plain"}, {"encoder": "b", "codes": True}, {**FRESH, "frame_stack": 1}], ids=str
)
def test_it_does_what_it_is_asked_for(world, tmp_path, kind):
    """The data's actions are of all degrees of skill; only the returns tell one from the other."""
    encoder = {"encoder": world / kind["encoder"]} if "encoder" in kind else {"encoder": None}
    many = record_choices(tmp_path / "many.h5", 400)
    reached = {}
    for target in (STEPS, 0):
        run = tmp_path / str(target)
        trained(world, run, **{**LEARNING, **kind, **encoder, "data": many, "target_return": float(target)})
        reached[target] = outcome(run)["measures"]["return"]
    assert reached[STEPS] > 5.5 and reached[0] < 1.0  # the data reach 4 on average


def test_what_is_written(world, tmp_path):
    run = tmp_path / "r"
    told = trained(world, run, evaluate_every=2, epochs=3, film=2, stride=4)
    found = outcome(run)
    measures, configuration = found["measures"], found["configuration"]
    assert set(measures) == {"return", "return_deviation", "loss", "accuracy"}
    assert found["agent"] == configuration["agent"] == "dt" and found["target_return"] == STEPS
    assert found["environment"] == "dt_tests/Choices-v0" and found["maps"] == {} and found["environment_options"] == {}
    assert found["data"]["file"] == "d.h5" and len(found["data"]["fingerprint"]) > 8
    assert told == (
        f"return {measures['return']:.1f} over 4 episodes, asked for 6; {measures['accuracy']:.1%} of the actions are "
        f"the data's after 3 epochs    wrote {run}"
    )
    with open(run / "progress.csv", newline="") as file:
        rows = list(csv.DictReader(file))
    steps = 2 * 96 // 16  # two windows in each of four fifths of the episodes
    assert [row["step"] for row in rows] == [str(steps), str(2 * steps), str(3 * steps)]
    assert [row["epoch"] for row in rows] == ["1", "2", "3"]
    assert [bool(row["eval/return"]) for row in rows] == [False, True, True]
    assert float(rows[-1]["eval/return"]) == pytest.approx(measures["return"], rel=1e-5)
    assert float(rows[-1]["train/accuracy"]) == pytest.approx(measures["accuracy"], rel=1e-5)
    assert float(rows[-1]["train/learning_rate"]) == pytest.approx(6e-4 * schedule(3 * 576, 50, 6 * 576))
    losses = [float(row["train/loss"]) for row in rows]
    assert losses[-1] < losses[0] < 1.3 and measures["loss"] == pytest.approx(losses[-1], rel=1e-5)
    there = {path.name for path in run.iterdir() if "tfevents" not in path.name}
    assert there == {
        "finetune.json", "progress.csv", "outcome.json", "policy.safetensors", "evaluation.mp4", "checkpoints",
        "latents.h5",
    }  # fmt: skip
    assert len(list((run / "checkpoints").iterdir())) == 3 and json.loads((run / "finetune.json").read_text()) == (
        configuration
    )


def test_one_that_is_stopped_while_it_is_filmed_is_not_finished(world, tmp_path, monkeypatch):
    run, error = tmp_path / "r", SystemExit(143)

    def fail(*_):
        raise error

    with monkeypatch.context() as patch, pytest.raises(SystemExit):
        patch.setattr(outcomes, "write_film", fail)
        trained(world, run, film=1)
    assert not (run / "outcome.json").exists()
    trained(world, run, film=1, resume=True)
    assert (run / "outcome.json").is_file() and (run / "evaluation.mp4").is_file()
    error = UserError("the disk is full")
    with monkeypatch.context() as patch, pytest.raises(UserError):
        patch.setattr(outcomes, "write_film", fail)
        trained(world, tmp_path / "full", film=1)
    assert outcome(tmp_path / "full")["measures"] == outcome(run)["measures"]


def test_an_encoder_that_was_trained_is_a_bundle(world, tmp_path):
    run = tmp_path / "r"
    trained(world, run, encoder=None, env="none", **FRESH)
    measures = outcome(run)["measures"]
    assert set(measures) == {"loss", "accuracy"} and outcome(run)["environment"] == "none"
    encoder = load_encoder(run / "bundle")
    assert encoder.spec.frame_stack == 2 and encoder.features == SMALL["width"] and not (run / "latents.h5").exists()
    state = torch.load(run / "checkpoints" / "step-00000036.ckpt", weights_only=True)["weights"]
    for name, value in encoder.encoder.state_dict().items():
        assert torch.equal(value, state[f"encoder.{name}"])


def test_everything_hangs_on_the_seed_alone(world, tmp_path):
    def measures(name, seed):
        torch.manual_seed(len(name))  # what was drawn before says nothing
        trained(world, tmp_path / name, seed=seed, dropout=0.1)
        return outcome(tmp_path / name)["measures"]

    assert measures("a", 3) == measures("bb", 3) != measures("c", 4)


def test_a_run_is_replaced_where_that_is_asked_for(world, tmp_path):
    run = tmp_path / "r"
    trained(world, run, env="none", steps_per_epoch=1)
    (run / "mine.txt").touch()
    with pytest.raises(UserError, match=r"exists already; choose another folder or pass --overwrite$"):
        trained(world, run, env="none")
    trained(world, run, env="none", steps_per_epoch=2, overwrite=True)
    assert not (run / "mine.txt").exists()
    assert sorted(path.name for path in (run / "checkpoints").iterdir()) == ["step-00000002.ckpt", "step-00000004.ckpt"]


def test_a_loss_that_is_no_number_ends_it_with_one_line(world, tmp_path, monkeypatch):
    plain = DecisionTransformerModule.training_step

    def spoilt(self: LightningModule, batch, number):
        plain(self, batch, number)
        if number == 2:
            self.network.head.weight.data.fill_(float("nan"))

    monkeypatch.setattr(DecisionTransformerModule, "training_step", spoilt)
    with pytest.raises(UserError, match=r"^the loss is nan after 10 updates; try a smaller --learning_rate$"):
        trained(world, tmp_path / "r", steps_per_epoch=10)
    assert not (tmp_path / "r" / "outcome.json").exists() and not (tmp_path / "r" / "checkpoints").exists()


@pytest.mark.parametrize(
    ("changed", "told"),
    [
        ({"heads": 3}, "--heads 3: must divide --width 16"),
        ({"epochs": 0}, "--epochs must be at least 1, is 0"),
        ({"steps_per_epoch": 0}, "--steps_per_epoch must be at least 1, is 0"),
        ({"dropout": 1.0}, "--dropout must be at least 0 and below 1, is 1.0"),
        ({"temperature": -0.5}, "--temperature must be finite and not negative, is -0.5"),
        ({"learning_rate": 0.0}, "--learning_rate must be above 0 and finite, is 0.0"),
        ({"target_return": float("nan")}, "--target_return must be a finite number, is nan"),
        ({"target_return": float("inf")}, "--target_return must be a finite number, is inf"),
        ({"warmup_tokens": -1}, "--warmup_tokens must be from 0 to 4294967295, is -1"),
        (
            {"stride": 5},
            "--stride 5: windows of --context 4 would leave steps of the data out; choose at most 4",
        ),
        (
            {"kernels": [3]},
            "--kernels is of an encoder that is trained end to end; leave it out beside --encoder",
        ),
        (
            {"encoder": None, "codes": True},
            "--codes are those of an encoder that is given; add --encoder, or leave it out",
        ),
        (
            {"encoder": None, "strides": [2, 1]},
            "one number for each convolution is needed in each of these: --channels 3, --kernels 3, --strides 2 are "
            "given",
        ),
        ({"encoder": None, "frame_stack": 0}, "--frame_stack must be at least 1, is 0"),
        ({"encoder": None, "channels": []}, "--channels must be at least 1, is []"),
        ({"device": "gpu"}, "--device gpu: there is no such device, did you mean 'cpu'? (choices: auto, cpu, cuda)"),
    ],
    ids=str,
)
def test_bad_options_are_told_before_anything_is_opened(world, tmp_path, changed, told):
    given = {**SMALL, "data": tmp_path / "absent.h5", "encoder": world / "b", **changed}
    with pytest.raises(UserError) as caught:
        finetune_dt(**given, run=tmp_path / "r")
    assert str(caught.value) == told and not (tmp_path / "r").exists()


def test_what_does_not_fit_leaves_no_folder(world, tmp_path):
    run, env = tmp_path / "r", register_choices()

    def told(**changes):
        with pytest.raises(UserError) as caught:
            trained(world, run, **changes)
        assert not run.exists() and "\n" not in str(caught.value)
        return str(caught.value)

    assert told(encoder=world / "plain", codes=True) == (
        f"--codes: the bottleneck of --encoder {world / 'plain'} has none; leave it out"
    )
    continuous = write_offline(tmp_path / "c.h5")
    assert told(data=continuous) == f"{continuous}: finetune dt needs discrete actions, these are continuous"
    assert "has no observation 'frame'" in told(data=write_discrete(tmp_path / "o.h5"), env="none")
    assert told(env=register_quadrants()).endswith("the data have 3 discrete ones")
    assert told(env="Choise-v0").startswith("--env Choise-v0: no such environment")
    assert told(env="") == (
        f"{world / 'd.h5'}: does not tell in which environment it was recorded; name one with --env, or train without "
        "evaluation with --env none"
    )
    assert told(env=env, data=tmp_path / "absent.h5").startswith(f"{tmp_path / 'absent.h5'}: no such data file")
    assert told(encoder=tmp_path / "absent").startswith(f"--encoder {tmp_path / 'absent'}: no such bundle")
    wide = choices_bundle(tmp_path / "wide", stack=1)
    assert told(encoder=wide, env="CartPole-v1", data=two_actions(tmp_path / "two.h5")).startswith(
        f"--encoder {wide}: does not fit --env CartPole-v1: "
    )
    run = tmp_path
    with pytest.raises(UserError, match=r"^--run .*: is no run of finetune, so --overwrite does not replace it$"):
        trained(world, tmp_path, overwrite=True)


def write_discrete(path):
    from repdib_lightning.records import ActionSpec

    return write_offline(path, actions=ActionSpec("discrete", ACTIONS))


def two_actions(path):
    """A store whose actions are those of CartPole."""
    random_store(path)
    with h5py.File(path, "r+") as file:
        file["actions"][:] = np.minimum(file["actions"][:], 1)
        for key, value in file["actions"].attrs.items():
            if value == ACTIONS:
                file["actions"].attrs[key] = 2
    return path


def test_the_check_of_a_suite_finds_what_the_verb_would(world, tmp_path):
    import inspect

    defaults = {name: item.default for name, item in inspect.signature(finetune_dt).parameters.items()}

    def checked(**changes):
        check_dt(**{**defaults, **SMALL, "data": world / "d.h5", "env": register_choices(), **changes})

    Choices.opened.clear()
    checked()
    checked(data=tmp_path / "not yet.h5")
    assert len(Choices.opened) == 1
    for changes, told in (
        ({"heads": 3}, "must divide"),
        ({"data": write_offline(tmp_path / "c.h5")}, "needs discrete actions"),
        ({"env": register_quadrants()}, "the data have 3 discrete ones"),
    ):
        with pytest.raises(UserError, match=told):
            checked(**changes)
    assert AGENTS["dt"].startswith("repdib_lightning.rl.finetune_dt:") and CHECKS["dt"].endswith(":check_dt")


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (["--target_return", "ten"], "error: target_return: expected float, got 'ten'"),
        (["--target_return", "nan"], "error: target_return: must be a finite number, is nan"),
        (["--contxt", "5"], "error: unknown option --contxt, did you mean '--context'?"),
        (["--env_options.game"], "error: argument --env_options: expected one argument"),
    ],
)
def test_bad_words_are_one_line(world, capsys, words, told):
    code = main(["finetune", "dt", "--data", str(world / "d.h5"), *words])
    assert code == 2 and capsys.readouterr().err.strip() == told


def test_the_command_line_trains(world, tmp_path, capsys):
    run = tmp_path / "r"
    small = [word for name, value in SMALL.items() for word in (f"--{name}", str(value))]
    words = ["--data", str(world / "d.h5"), "--encoder", str(world / "b"), "--codes", "--steps_per_epoch", "2"]
    assert main(["finetune", "dt", *words, *small, "--run", str(run)]) in (0, None)
    assert capsys.readouterr().out.strip().endswith(f"of the actions are the data's after 2 epochs    wrote {run}")
    assert outcome(run)["configuration"]["codes"] is True
