"""Runs of the rivals through the real entry point: bad input, exact resumption, export of every combination."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
import yaml

from repdib_lightning.__main__ import main
from repdib_lightning.callbacks import last_good
from repdib_lightning.configurations import resolve
from repdib_lightning.export import load_encoder
from repdib_lightning.export.formats import example_batch

RIVALS = ("bottleneck/svib", "bottleneck/emi", "bottleneck/db", "objective/forward_prediction")


def fit(run: str, *names: str, steps: int = 4) -> list[str]:
    layers = [argument for name in names for argument in ("--config", str(name))]
    return [
        *("fit", "--config", "base.yaml", *layers, "--run", run, "--trainer.max_steps", str(steps)),
        *("--trainer.val_check_interval", "2", "--trainer.enable_progress_bar", "false", "--checkpoint_every", "2"),
    ]


@pytest.fixture
def here(tmp_path, monkeypatch, store_file):
    monkeypatch.chdir(tmp_path)
    plain = yaml.safe_load(resolve("robot_arm").read_text())
    plain["data"] = {
        "class_path": "EpisodeDataModule",
        "init_args": {"path": "small.h5", "batch_size": 8, "horizon": 3},
    }
    plain["model"]["encoder"]["init_args"] = {"features": 16, "channels": 4, "strides": [2, 2]}
    plain["model"]["bottleneck"]["init_args"] = {"groups": 4, "codes": 5, "start_step": 1}
    Path("base.yaml").write_text(yaml.safe_dump(plain))
    return tmp_path


def state(run: str) -> dict[str, torch.Tensor]:
    return torch.load(last_good(Path(run)), weights_only=True)["state_dict"]


@pytest.mark.parametrize("name", RIVALS)
def test_a_resumed_run_ends_as_one_that_never_stopped_and_is_exported(here, name):
    assert main(fit("runs/whole", name)) == 0
    assert main(fit("runs/broken", name, steps=2)) == 0
    assert main(["fit", "--resume", "runs/broken", "--trainer.max_steps", "4"]) == 0
    whole, broken = state("runs/whole"), state("runs/broken")
    assert whole.keys() == broken.keys()
    assert all(torch.equal(value, broken[key]) for key, value in whole.items())
    if name == "bottleneck/db":
        copies = [key for key in whole if key.startswith("objective.parts.1.momentum.")]
        assert len(copies) == 8
    assert main(["export", "runs/whole"]) == 0
    frozen = load_encoder("runs/whole/bundle")
    assert frozen.spec.next_frame is (name != "bottleneck/svib")
    latent = frozen.encode(example_batch(frozen.spec, 3))
    assert latent.shape == (3, 16) and torch.isfinite(latent).all()
    assert (
        type(frozen.bottleneck).__name__
        == yaml.safe_load(resolve(name).read_text())["model"].get("bottleneck", {"class_path": "RepDIB"})["class_path"]
    )


def parts(*items: object) -> dict[str, object]:
    return {"model": {"objective": {"class_path": "SeveralObjectives", "init_args": {"parts": list(items)}}}}


INVERSE = {"class_path": "InverseDynamics"}


@pytest.mark.parametrize(
    ("overlay", "wanted"),
    [
        (parts({"class_path": "InversDynamics"}), "parts: unknown class 'InversDynamics', did you mean 'InverseDynam"),
        (
            parts({"class_path": "RepDIB"}),
            "model.objective.parts: unknown class 'RepDIB', choices: Classification, DRIML",
        ),
        (parts(INVERSE, {"class_path": "EMI", "init_args": {"dimension": 3}}), "parts.dimension, did you mean 'dimens"),
        (parts({"class_path": "DRIML", "init_args": {"hidden": "x"}}), "parts.hidden: expected int, got 'x'"),
        (parts({"class_path": "DRIML", "hidden": 3}), "parts: options of a class belong under its init_args"),
        (parts({"class_path": "DRIML", "init_arg": {"hidden": 3}}), "parts.init_arg, did you mean 'init_args'?"),
        (parts(7), "model.objective.parts: expected a class, got '7', choices: Classification, DRIML"),
        (parts(), "SeveralObjectives: parts is empty"),
        (parts(INVERSE, INVERSE), "InverseDynamics and InverseDynamics both give 'inverse'"),
        (parts(INVERSE, {"class_path": "EMI"}), "EMI: needs the frame after the anchor in every sample; set data.next"),
        (parts({"class_path": "DRIML", "init_args": {"hidden": 0}}), "DRIML: hidden must be at least 1, is 0"),
        ({"model": {"objective": {"class_path": "SeveralObjectives"}}}, "following arguments are required: parts"),
        ({"model": {"bottleneck": {"class_path": "SVIBB"}}}, "unknown class 'SVIBB', did you mean 'SVIB'?"),
        ({"model": {"loss_weights": {"informaton": 1.0}}}, "no loss is called 'informaton' in this run"),
        ({"data": {"next_fram": True}}, "next_fram"),
        ({"data": {"next_frame": "maybe"}}, "data.next_frame: expected bool, got 'maybe'"),
    ],
)
def test_one_line(here, capsys, overlay, wanted):
    Path("overlay.yaml").write_text(yaml.safe_dump(overlay))
    assert main(fit("runs/x", "overlay.yaml")) == 2
    lines = [line for line in capsys.readouterr().err.strip().splitlines() if not line.startswith("Seed set")]
    assert len(lines) == 1 and wanted in lines[0], lines
    assert not Path("runs").exists()


def test_the_next_frame_changes_no_draw_of_a_run(here):
    """The same anchors, futures and first weights; only the pictures' shift and the batch of the bottleneck differ."""
    Path("next.yaml").write_text(yaml.safe_dump({"data": {"next_frame": True}, "model": {"shift": 0}}))
    Path("plain.yaml").write_text(yaml.safe_dump({"model": {"shift": 0}}))
    for run in ("next", "plain"):
        assert main(fit(f"runs/{run}", "bottleneck/none", f"{run}.yaml")) == 0
    first, second = state("runs/next"), state("runs/plain")
    for key, value in first.items():
        torch.testing.assert_close(value, second[key], rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("precision", ["bf16-mixed", "bf16-true"])
@pytest.mark.parametrize("name", RIVALS)
def test_half_precision_trains(here, name, precision):
    assert main([*fit("runs/x", name, steps=2), "--trainer.precision", precision]) == 0
    assert all(torch.isfinite(value).all() for value in state("runs/x").values())
