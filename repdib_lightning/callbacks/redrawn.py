"""Shows in TensorBoard what an autoencoder draws of held-out pictures, whole and without each group of its latent."""

from __future__ import annotations

import lightning.pytorch as pl
import numpy as np
import torch
from lightning.pytorch.callbacks import Callback
from torch import Tensor

from repdib_lightning.bottlenecks.group_edits import GroupLayout
from repdib_lightning.callbacks.pictures import tensorboards
from repdib_lightning.data.datamodule import EpisodeDataModule
from repdib_lightning.objectives.reconstruction import as_shares
from repdib_lightning.representation import RepresentationModule

MOST_GROUPS = 8


class Redrawn(Callback):
    """Logs ``drawn/<picture>`` after every validation: a column a picture; its lines are the picture, what is drawn of
    it, and, where the bottleneck quantises into at most 8 groups, what is drawn with each of them set to 0 (the paper's
    PACS figure), then with each of them taken from the column to the right. Runs without a decoder log nothing.

    Args:
        samples: columns.
    """

    def __init__(self, samples: int = 8) -> None:
        self.samples = samples

    def on_validation_epoch_end(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Draw some held-out pictures; no draw or buffer of the training changes."""
        assert isinstance(pl_module, RepresentationModule)
        found = pl_module.objective.find_decoder()
        data = getattr(trainer, "datamodule", None)
        writers = list(tensorboards(trainer))
        if found is None or not writers or not isinstance(data, EpisodeDataModule):
            return
        decoder = found[1]
        batch = data.example(self.samples)
        seen = {name: frames[:, 0].to(pl_module.device) for name, frames in batch.observations.items()}
        with torch.no_grad(), trainer.precision_plugin.val_step_context():
            latent = pl_module(seen).latent
            lines = [as_shares(seen[decoder.view], latent.dtype), decoder(latent)]
            lines += [decoder(part) for part in _edited(latent, pl_module)]
        for writer in writers:
            writer.add_image(f"drawn/{decoder.view}", mosaic(lines), trainer.global_step)


def _edited(latent: Tensor, module: RepresentationModule) -> list[Tensor]:
    """(N, M) without each group, then with each group of the next row."""
    positions = module.encoder.positions
    layout = GroupLayout(positions, module.bottleneck.groups // positions)
    if not module.bottleneck.ready or not 1 <= layout.groups <= MOST_GROUPS:
        return []
    rows = latent.float().cpu().numpy()
    edited = [layout.zeroed(rows, group) for group in range(layout.groups)]
    edited += [layout.swapped(rows, np.roll(rows, -1, axis=0), group) for group in range(layout.groups)]
    return [torch.from_numpy(part).to(latent) for part in edited]


def mosaic(lines: list[Tensor]) -> Tensor:
    """Lines of pictures (n, S * C, H, W), 0 to 1, as one (3, R * H, n * W) picture of the newest frames."""
    channels = 3 if lines[0].shape[1] % 3 == 0 else 1
    shown = torch.stack([line[:, -channels:].clamp(0.0, 1.0).float().cpu() for line in lines]).expand(-1, -1, 3, -1, -1)
    rows, columns, _, height, width = shown.shape
    return shown.permute(2, 0, 3, 1, 4).reshape(3, rows * height, columns * width)
