"""bfloat16 training stays close to float32 training, and what must be exact stays float32."""

import csv
import sys
from pathlib import Path

import pytest
import torch

sys.path.insert(0, str(Path(__file__).parent))
from killing import command

from repdib_lightning.callbacks import last_good

STEPS = 12


def losses(folder):
    with open(folder / "run/metrics.csv", newline="") as file:
        return [float(row["train/loss"]) for row in csv.DictReader(file) if row.get("train/loss")]


@pytest.fixture(scope="module")
def runs(tmp_path_factory, make_store):
    folders = {}
    for precision in ("32-true", "bf16-mixed"):
        folder = folders[precision] = tmp_path_factory.mktemp(precision)
        make_store(folder / "small.h5")
        code = command(
            *(folder, "fit", "--data", "EpisodeDataModule", "--data.path", "small.h5", "--run", "run"),
            *("--data.batch_size", "8", "--data.horizon", "2", "--model.encoder.init_args.features", "32"),
            *("--model.bottleneck.init_args.start_step", "4", "--model.bottleneck.init_args.codes", "6"),
            *("--trainer.max_steps", str(STEPS), "--trainer.log_every_n_steps", "1", "--trainer.precision", precision),
            *("--trainer.enable_progress_bar", "false", "--trainer.accelerator", "cpu"),
        )
        assert code == 0, (folder / "output.txt").read_text()
    return folders


def test_the_losses_agree(runs):
    single, half = (losses(folder) for folder in runs.values())
    assert len(single) == STEPS
    assert single != half
    assert half == pytest.approx(single, rel=0.05)


def test_weights_and_codes_stay_in_float32(runs):
    state = torch.load(last_good(runs["bf16-mixed"] / "run"), weights_only=True)["state_dict"]
    assert {value.dtype for value in state.values() if value.is_floating_point()} == {torch.float32}
    assert state["bottleneck.quantiser.started"]
