"""Classification: recognise a factor of the data."""

from __future__ import annotations

from collections.abc import Callable

import torch
import torch.nn.functional as F
from torch import Tensor
from torchmetrics import MetricCollection
from torchmetrics.classification import MulticlassAccuracy, MulticlassConfusionMatrix, MulticlassF1Score

from repdib_lightning.classifiers import Classifier, LinearClassifier
from repdib_lightning.errors import UserError
from repdib_lightning.objectives.base import Encode, Objective
from repdib_lightning.records import Batch, DataSpec, ObjectiveOutput


class Classification(Objective):
    """Cross-entropy of the class of ``data.target`` that a classifier tells from the anchor's latent (paper, MMAct).

    Set ``data.futures`` to 0: later frames are not looked at.

    Losses: ``classification``, the mean over samples, in nats. Metrics: ``accuracy`` of the batch; over the whole
    held-out set ``accuracy``, ``f1_macro`` (the mean over the classes that occur there or are predicted, which is
    torchmetrics' rule), ``f1_micro`` (equal to the accuracy, where each sample has one class) and ``f1_weighted`` (by
    how often a class occurs), and the table ``confusion`` (classes, predicted classes), counts.

    Args:
        width: M.
        spec: of the data.
        classifier: builds the classifier from the spec and the width.
        label_smoothing: share of the wanted probability that is spread over all classes, from 0 to 1; the held-out
            loss has it too.

    Raises:
        UserError: as the classifier, or a smoothing outside [0, 1].
    """

    classifier: Classifier

    def __init__(
        self,
        width: int,
        spec: DataSpec,
        *,
        classifier: Callable[[DataSpec, int], Classifier] = LinearClassifier,
        label_smoothing: float = 0.0,
    ) -> None:
        super().__init__()
        if not 0.0 <= label_smoothing <= 1.0:
            raise UserError(f"Classification: label_smoothing must be in 0..1, is {label_smoothing}")
        self.classifier = classifier(spec, width)
        self.label_smoothing = label_smoothing

    def forward(self, batch: Batch, encode: Encode) -> ObjectiveOutput:
        """Encode (B, F) frames and classify the anchors. Raises UserError where the batch has no targets."""
        if batch.targets is None:
            raise UserError("Classification: the samples have no classes; set data.target to a categorical factor")
        scores = self.classifier(encode(batch.observations)[:, 0]).float()
        loss = F.cross_entropy(scores, batch.targets, label_smoothing=self.label_smoothing)
        with torch.no_grad():
            predicted = scores.argmax(dim=1)
            accuracy = (predicted == batch.targets).float().mean()
        counted: dict[str, tuple[Tensor, ...]] = {"classes": (predicted, batch.targets)}
        return ObjectiveOutput({"classification": loss}, {"accuracy": accuracy}, counted)

    def held_out_metrics(self) -> dict[str, MetricCollection]:
        """F1 scores, accuracy and confusion of the classes."""
        return {"classes": class_metrics(len(self.classifier.classes))}


def class_metrics(classes: int) -> MetricCollection:
    """Metrics of predicted (N,) and true (N,) classes, int64: the F1 scores, ``accuracy`` and ``confusion``."""
    # Checks of every batch would wait for the device.
    return MetricCollection(
        {
            "f1_macro": MulticlassF1Score(classes, average="macro", validate_args=False),
            "f1_micro": MulticlassF1Score(classes, average="micro", validate_args=False),
            "f1_weighted": MulticlassF1Score(classes, average="weighted", validate_args=False),
            "accuracy": MulticlassAccuracy(classes, average="micro", validate_args=False),
            "confusion": MulticlassConfusionMatrix(classes, validate_args=False),
        },
        # Stated, since groups that are found by comparing counts could differ between processes.
        compute_groups=[["f1_macro", "f1_weighted"], ["f1_micro", "accuracy"], ["confusion"]],
    )
