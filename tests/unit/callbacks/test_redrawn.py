"""The drawings in TensorBoard: right tiles, and no trace in the training."""

from __future__ import annotations

import lightning.pytorch as pl
import numpy as np
import pytest
import torch
from lightning.pytorch.loggers import TensorBoardLogger
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from repdib_lightning.bottlenecks import RepDIB
from repdib_lightning.callbacks.redrawn import Redrawn, mosaic
from repdib_lightning.data.datamodule import EpisodeDataModule
from repdib_lightning.data.writer import EpisodeWriter
from repdib_lightning.decoders import ResidualDecoder
from repdib_lightning.encoders import ResidualEncoder
from repdib_lightning.objectives import Reconstruction
from repdib_lightning.records import ArraySpec
from repdib_lightning.representation import RepresentationModule

SMALL = {"channels": 4, "stages": 2}


def test_a_mosaic_puts_each_picture_into_its_tile():
    lines = [torch.rand(4, 6, 5, 7) for _ in range(3)]
    whole = mosaic(lines)
    assert whole.shape == (3, 3 * 5, 4 * 7)
    for row, line in enumerate(lines):
        for column, picture in enumerate(line):
            tile = whole[:, row * 5 : row * 5 + 5, column * 7 : column * 7 + 7]
            assert torch.equal(tile, picture[-3:]), "the newest frame of the stack"
    assert torch.equal(mosaic([torch.full((1, 1, 2, 2), 1.5)]), torch.ones(3, 2, 2))


@pytest.fixture
def store(tmp_path):
    path, random = tmp_path / "pictures.h5", np.random.default_rng(0)
    writer = EpisodeWriter(path, rows=20, episodes=20, observations={"eye": ArraySpec((3, 16, 16))}, actions=None)
    with writer:
        for number in range(20):
            picture = random.integers(256, size=(1, 3, 16, 16), dtype=np.uint8)
            writer.add_episode(observations={"eye": picture}, evaluation=number >= 15)
    return path


def train(folder, store, grid, precision, *callbacks):
    pl.seed_everything(0)
    module = RepresentationModule(
        lambda spec: ResidualEncoder(spec, features=4, grid=grid, **SMALL),
        lambda width: RepDIB(width, groups=2, codes=5, start="random", start_step=0),
        lambda width, spec: Reconstruction(width, spec, decoder=lambda s, w: ResidualDecoder(s, w, grid=grid, **SMALL)),
        shift=0,
    )
    trainer = pl.Trainer(
        max_steps=4,
        val_check_interval=2,
        precision=precision,
        logger=TensorBoardLogger(folder, name="", version=""),
        callbacks=list(callbacks),
        accelerator="cpu",
        enable_progress_bar=False,
        enable_checkpointing=False,
        enable_model_summary=False,
    )
    trainer.fit(module, datamodule=EpisodeDataModule(str(store), batch_size=5, futures=0))
    return {name: value.clone() for name, value in module.state_dict().items()}


@pytest.mark.parametrize(("grid", "precision"), [(False, "32-true"), (True, "32-true"), (False, "bf16-true")])
def test_drawings_are_logged_and_leave_the_training_as_it_is(tmp_path, store, grid, precision):
    with_it = train(tmp_path / "with", store, grid, precision, Redrawn(samples=3))
    without = train(tmp_path / "without", store, grid, precision)
    assert all(torch.equal(value, without[name]) for name, value in with_it.items())
    events = EventAccumulator(str(tmp_path / "with"), size_guidance={"images": 0}).Reload()
    assert events.Tags()["images"] == ["drawn/eye"]
    first, last = events.Images("drawn/eye")[0], events.Images("drawn/eye")[-1]
    # the picture, all groups, without each of two, and with each of two of the next picture
    assert (first.width, first.height) == (3 * 16, 6 * 16)
    assert first.encoded_image_string != last.encoded_image_string
