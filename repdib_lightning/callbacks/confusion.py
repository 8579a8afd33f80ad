"""Shows in TensorBoard which classes of the held-out data are taken for which."""

from __future__ import annotations

import lightning.pytorch as pl
import numpy as np
from lightning.pytorch.callbacks import Callback

from repdib_lightning.callbacks.pictures import tensorboards
from repdib_lightning.representation import RepresentationModule

MOST_NUMBERED = 20


class Confusion(Callback):
    """Logs ``confusion`` after every validation: a line for each class, a column for each that it was taken for, the
    darker, the larger its share of the line. Runs that recognise nothing log nothing.
    """

    def on_validation_end(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Draw the counts of the whole held-out set of all processes."""
        assert isinstance(pl_module, RepresentationModule)
        found, writers = pl_module.objective.find_classifier(), list(tensorboards(trainer))
        counts = pl_module.tables.get("confusion")
        if found is None or counts is None or not writers or trainer.sanity_checking:
            return
        picture = draw_confusion(counts.cpu().numpy(), found[1].target, found[1].classes)
        for writer in writers:
            writer.add_image("confusion", picture, trainer.global_step, dataformats="HWC")


def draw_confusion(counts: np.ndarray, target: str, classes: tuple[str, ...]) -> np.ndarray:
    """Draw counts of (classes, predicted classes) as (H, W, 3) uint8; up to 20 classes with the numbers.

    Args:
        counts: how often each class was taken for each.
        target: the factor.
        classes: names of its values.
    """
    # Only here, since most runs draw none and importing it takes half a second.
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    shares = counts / np.maximum(counts.sum(1, keepdims=True), 1)
    side = 2.0 + 0.3 * len(classes)
    figure = Figure((side, side), dpi=80, layout="constrained")
    canvas, axes = FigureCanvasAgg(figure), figure.subplots()
    axes.imshow(shares, cmap="Blues", vmin=0.0, vmax=1.0)
    axes.set_xticks(range(len(classes)), classes, rotation=90, fontsize=8)
    axes.set_yticks(range(len(classes)), classes, fontsize=8)
    axes.set(xlabel=f"predicted {target}", ylabel=f"true {target}")
    for (line, column), count in np.ndenumerate(counts):
        if count and len(classes) <= MOST_NUMBERED:
            colour = "white" if shares[line, column] > 0.5 else "black"
            axes.text(column, line, str(count), ha="center", va="center", fontsize=8, color=colour)
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())[:, :, :3].copy()
