"""Without the command line: the module, the data module and a Trainer of one's own."""

from __future__ import annotations

import lightning.pytorch as pl
import torch

from repdib_lightning.bottlenecks import RepDIB
from repdib_lightning.data.datamodule import EpisodeDataModule
from repdib_lightning.encoders import ConvolutionalEncoder
from repdib_lightning.export import load_encoder, save_bundle
from repdib_lightning.objectives import InverseDynamics
from repdib_lightning.representation import RepresentationModule


def test_train_and_hand_over_in_python(store_file, tmp_path):
    data = EpisodeDataModule(str(store_file), batch_size=4, horizon=2)
    model = RepresentationModule(
        encoder=lambda spec: ConvolutionalEncoder(spec, features=16, strides=[2, 2]),
        bottleneck=lambda width: RepDIB(width, groups=4, codes=4, start_step=1),
        objective=InverseDynamics,
    )
    quiet = {"logger": False, "enable_checkpointing": False, "enable_progress_bar": False}
    trainer = pl.Trainer(max_steps=4, accelerator="cpu", use_distributed_sampler=False, **quiet)
    trainer.fit(model, datamodule=data)
    assert trainer.global_step == 4 and model.bottleneck.ready
    folder = save_bundle(tmp_path / "bundle", model.encoder, model.bottleneck, training={}, data={})
    pictures = {name: array[:, 0] for name, array in data.example().observations.items()}
    encoder = load_encoder(folder)
    with torch.no_grad():
        assert torch.equal(encoder.encode(pictures), model.eval()(pictures).latent)
