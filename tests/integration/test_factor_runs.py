"""An autoencoder with groups of codes from drawings to figures and measures, through the real entry point."""

from __future__ import annotations

import json
import shutil
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import torch
import yaml
from PIL import Image

from repdib_lightning.__main__ import main
from repdib_lightning.callbacks import last_good
from repdib_lightning.configurations import resolve
from repdib_lightning.data.episodes import EpisodeStore
from repdib_lightning.evaluation import group_drawing
from repdib_lightning.evaluation.factor_classifier import judge_of
from repdib_lightning.evaluation.factor_figures import FIGURES
from repdib_lightning.evaluation.splits import rows_of
from repdib_lightning.export import load_decoder, load_encoder
from repdib_lightning.export.formats import example_batch

DRAWINGS = Path(__file__).parents[2] / "data" / "emoji_styles"
STYLES, SPECIES = ("noto", "openmoji", "twemoji"), ("cat", "dog", "elephant", "fox", "owl", "pig")
SMALL = {"channels": 4, "stages": 2}


@pytest.fixture(scope="module")
def drawings(tmp_path_factory):
    """18 drawings of the committed ones, twice each, at 16 px."""
    folder = tmp_path_factory.mktemp("drawings")
    for style in STYLES:
        (folder / "some" / style).mkdir(parents=True)
        for species in SPECIES:
            shutil.copy(DRAWINGS / style / f"{species}.png", folder / "some" / style)
    options = ["--source", str(folder / "some"), "--size", "16", "--variants", "2", "--held_out", "0.4"]
    assert main(["collect", "emoji_styles", str(folder / "small.h5"), *options]) == 0
    return folder / "small.h5"


@pytest.fixture
def here(tmp_path, monkeypatch, drawings):
    """``base.yaml`` is the packaged configuration, shrunk; the judge of pictures is trained for a moment only."""
    monkeypatch.chdir(tmp_path)
    shutil.copy(drawings, "small.h5")
    plain = yaml.safe_load(resolve("factors").read_text())
    plain["data"]["init_args"] |= {"path": "small.h5", "batch_size": 8}
    del plain["data"]["init_args"]["collect"]
    plain["model"]["encoder"]["init_args"] |= {"features": 8, **SMALL}
    plain["model"]["bottleneck"]["init_args"] |= {"codes": 6, "start_step": 1}
    plain["model"]["objective"]["init_args"]["decoder"]["init_args"] = dict(SMALL)
    Path("base.yaml").write_text(yaml.safe_dump(plain))
    monkeypatch.setattr(group_drawing, "judge_of", partial(judge_of, steps=3))
    return tmp_path


def fit(run, *overlays, steps=4, every=2):
    layers = [argument for name in overlays for argument in ("--config", name)]
    return [
        *("fit", "--config", "base.yaml", *layers, "--run", run, "--trainer.max_steps", str(steps)),
        *("--trainer.val_check_interval", str(every), "--checkpoint_every", str(every)),
        *("--trainer.enable_progress_bar", "false"),
    ]


def trained(run, *overlays, **options):
    assert main(fit(run, *overlays, **options)) == 0
    assert main(["export", run]) == 0
    return Path(run)


def state(run):
    return torch.load(last_good(Path(run)), weights_only=True)["state_dict"]


def check_figures(folder):
    assert {file.name for file in Path(folder).iterdir()} == {f"{figure}.png" for figure in FIGURES}
    for file in Path(folder).iterdir():
        with Image.open(file) as picture:
            picture.load()
            assert len(np.unique(np.asarray(picture.convert("L")))) > 10


def pictures_of(split):
    store = EpisodeStore("small.h5")
    return store.gather("observations/pixels", rows_of(store, store.episodes(split)))


def drawn_by(run, pictures):
    """Pictures drawn again by a run's bundle, in [0, 255]."""
    encoder, decoder = load_encoder(f"{run}/bundle"), load_decoder(f"{run}/bundle")
    return decoder(encoder.encode({"pixels": pictures})).clamp(0, 1).mul(255).round().detach().numpy()


def decibels(drawn, pictures):
    """Peak signal-to-noise ratio."""
    return -10 * np.log10(np.mean(np.square((drawn - pictures) / 255.0)))


def test_from_training_to_figures_probes_and_a_comparison(here, capsys):
    trained("runs/repdib")
    trained("runs/none", "bottleneck/none")
    assert main(["figures", "factors", "runs/repdib", "small.h5", "--pictures", "6"]) == 0
    check_figures("runs/repdib/factors")
    assert main(["figures", "factors", "runs/none", "small.h5", "--pictures", "6", "--groups", "2"]) == 0
    check_figures("runs/none/factors")

    assert main(["probe", "runs/repdib", "small.h5", "--probes", "linear,groups"]) == 0
    assert Path("small.judge.safetensors").is_file()
    report = json.loads(Path("runs/repdib/bundle/probe.json").read_text())
    grouped = report["grouped"]
    assert (grouped["positions"], grouped["groups"], grouped["codes"]) == (1, 2, "own")
    assert set(grouped["disentanglement"]["share"]) == {"style", "species", "background", "scale"}
    assert {"psnr", "psnr_gain", "style/moved", "style/moved_gap", "species/share"} <= set(grouped["figures"])
    pictures = pictures_of("evaluation")
    drawn = drawn_by("runs/repdib", pictures)
    assert grouped["figures"]["psnr"] == pytest.approx(decibels(drawn, pictures), abs=0.01)

    compared = ["compare", "small.h5", "page.html", "runs/none", "runs/repdib", "--probes", "linear,groups"]
    capsys.readouterr()
    assert main(compared) == 2
    assert "quantises nothing, so that it has no groups; cut its latent with --groups" in capsys.readouterr().err
    assert not Path("page.html").exists()
    assert main([*compared, "--groups", "2"]) == 0
    numbers = json.loads(Path("page.json").read_text())
    assert numbers["repdib"]["grouped"] == grouped
    assert numbers["none"]["grouped"]["codes"].startswith("k-means ")
    table = capsys.readouterr().out
    for text in (table, Path("page.html").read_text()):
        assert "groups: style/moved_gap" in text and "repdib: what each of 2 groups holds most: group 0 " in text


def test_training_draws_its_pictures_better_than_their_mean(here):
    learning = {
        "model": {
            "encoder": {"init_args": {"features": 32, "channels": 16}},
            "bottleneck": {"init_args": {"codes": 64, "start_step": 75}},
            "objective": {"init_args": {"decoder": {"init_args": {"channels": 16}}}},
            "optimizer": {"init_args": {"lr": 3e-3}},
        },
        "data": {"init_args": {"batch_size": 16}},
    }
    Path("learning.yaml").write_text(yaml.safe_dump(learning))
    trained("runs/learned", "learning.yaml", steps=150, every=150)
    pictures = pictures_of("train")
    gain = decibels(drawn_by("runs/learned", pictures), pictures) - decibels(pictures.mean(0), pictures)
    assert gain > 2.0  # measured: 5.7 dB; with other seeds 4.2 to 5.3


def test_a_comparison_of_quantised_runs_refuses_other_groups(here, capsys):
    trained("runs/a", steps=2)
    shutil.copytree("runs/a", "runs/b")
    compared = ["compare", "small.h5", "page.html", "runs/a", "runs/b", "--probes", "linear,groups", "--groups", "4"]
    capsys.readouterr()
    assert main(compared) == 2
    error = capsys.readouterr().err.splitlines()
    assert error == ["error: --groups 4: this encoder quantises 2 groups; leave the option out"]
    assert not Path("page.html").exists()


def test_a_grid_has_groups_at_every_position(here):
    run = trained("runs/grid", "factors_grid")
    encoder = load_encoder(run / "bundle")
    assert (encoder.encoder.positions, encoder.groups, encoder.features) == (16, 32, 128)
    assert main(["figures", "factors", "runs/grid", "small.h5", "--pictures", "4"]) == 0
    check_figures("runs/grid/factors")
    assert main(["probe", "runs/grid", "small.h5", "--probes", "linear,groups", "--output", "grid.json"]) == 0
    grouped = json.loads(Path("grid.json").read_text())["grouped"]
    assert (grouped["positions"], grouped["groups"], grouped["codes"]) == (16, 2, "own")
    assert len(grouped["drawing"]["psnr_zeroed"]) == len(grouped["disentanglement"]["share"]["style"]) == 2
    assert np.isfinite(grouped["drawing"]["psnr_zeroed"]).all()


@pytest.mark.parametrize("precision", ["bf16-mixed", "bf16-true"])
def test_what_was_trained_in_half_precision_is_exported_and_draws(here, precision):
    assert main([*fit("runs/half", steps=2), "--trainer.precision", precision]) == 0
    assert all(torch.isfinite(value).all() for value in state("runs/half").values())
    assert main(["export", "runs/half"]) == 0
    encoder, decoder = load_encoder("runs/half/bundle"), load_decoder("runs/half/bundle")
    drawn = decoder(encoder.encode(example_batch(encoder.spec, 3)))
    assert drawn.dtype == torch.float32 and drawn.shape == (3, 3, 16, 16) and torch.isfinite(drawn).all()
    assert main(["figures", "factors", "runs/half", "small.h5", "--which", "zeroed", "--pictures", "3"]) == 0
    assert Path("runs/half/factors/zeroed.png").is_file()


@pytest.mark.parametrize("overlays", [(), ("factors_grid",)])
def test_a_resumed_run_ends_as_one_that_never_stopped(here, overlays):
    assert main(fit("runs/whole", *overlays)) == 0
    assert main(fit("runs/broken", *overlays, steps=2)) == 0
    assert main(["fit", "--resume", "runs/broken", "--trainer.max_steps", "4"]) == 0
    whole, broken = state("runs/whole"), state("runs/broken")
    assert whole.keys() == broken.keys() and any(key.startswith("objective.decoder.") for key in whole)
    assert all(torch.equal(value, broken[key]) for key, value in whole.items())
    losses = [[line.split(",") for line in Path(f"runs/{run}/metrics.csv").read_text().splitlines()] for run in
              ("whole", "broken")]  # fmt: skip
    assert losses[0][0] == losses[1][0] and losses[0][-1] == losses[1][-1]
