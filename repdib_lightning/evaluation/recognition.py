"""The probe ``recognition``: how well the classifier of a bundle tells held-out clips, and what it needs for that.

Nothing is fitted. Every figure is of all held-out clips at once, never a mean over batches. Macro F1 is the mean over
the classes that occur in the held-out clips or were predicted for one of them, as torchmetrics has it: a class that
neither occurs nor is predicted is left out, one that is predicted and does not occur counts as 0.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
import torch
from torchmetrics.functional.classification import (
    multiclass_accuracy,
    multiclass_confusion_matrix,
    multiclass_f1_score,
)

from repdib_lightning.data.episodes import EpisodeStore
from repdib_lightning.errors import UserError
from repdib_lightning.evaluation.codes import entropy
from repdib_lightning.evaluation.recognition_classes import labels_of
from repdib_lightning.evaluation.recognition_pass import Looks, Recognised, Tells, recognise
from repdib_lightning.evaluation.recognition_without import others
from repdib_lightning.evaluation.splits import rows_of


@dataclass(frozen=True)
class Scores:
    """Four figures of the same predictions; micro F1 is the accuracy, since every clip has one class."""

    f1_macro: float
    f1_micro: float
    f1_weighted: float
    accuracy: float


@dataclass(frozen=True)
class RecognitionReport:
    """How well the classes of held-out clips are told.

    Attributes:
        target: the factor. classes: names of its values. clips: how many were scored.
        scores: with everything there.
        f1: class -> F1; None where it neither occurs nor is predicted.
        confusion: counts, a row a true class, a column a predicted one.
        without: modality -> scores with it missing of every clip.
        only: modality -> macro F1 with all others missing.
        attention: modality -> its mean weight over the clips of which anything was observed.
        perplexity: modality, or ``fused`` for the latent -> mean over the groups of 2^H of its codes.
    """

    target: str
    classes: list[str]
    clips: int
    scores: Scores
    f1: dict[str, float | None]
    confusion: list[list[int]]
    without: dict[str, Scores]
    only: dict[str, float]
    attention: dict[str, float]
    perplexity: dict[str, float]

    @property
    def chance(self) -> float:
        """Macro F1 of naming the most frequent class each time."""
        counts = np.sum(self.confusion, axis=1)
        share = counts.max() / counts.sum()
        return float(2 * share / (1 + share) / (counts > 0).sum())

    def to_dict(self) -> dict[str, Any]:
        """Plain dictionaries, lists, strings, numbers and None (JSON); the four scores are keys of their own."""
        plain = asdict(self)
        return {**plain.pop("scores"), **plain}


def measure_recognition(
    encoder: Looks,
    classifier: Tells,
    store: EpisodeStore,
    *,
    bundle: str = "the bundle",
    device: str | torch.device = "cpu",
    progress: bool = True,
) -> RecognitionReport:
    """Score a classifier on all held-out clips of a store, also with modalities missing.

    Args:
        encoder: frozen, on ``device``. classifier: of the same bundle, there too.
        store: opened with what the bundle holds out; a clip is a row.
        bundle: what to call it in errors.
        device: that runs both. progress: show a progress bar.

    Raises:
        UserError: a store without the factor, with other classes, or without held-out clips; NaN or infinite logits.
    """
    rows = rows_of(store, store.episodes("evaluation"))
    labels = checked_labels(classifier, store, rows, bundle)
    return report_of(recognise(encoder, classifier, store, rows, device=device, progress=progress), labels, classifier)


def checked_labels(classifier: Tells, store: EpisodeStore, rows: np.ndarray, bundle: str) -> np.ndarray:
    """The true classes of (n,) rows, (n,) int64; before anything is encoded. Raises UserError as measuring does."""
    labels = labels_of(store, rows, classifier.target, classifier.classes, bundle)
    if not len(rows):
        raise UserError(f"{store.path}: has no clips to recognise; mark some in 'episodes/evaluation'")
    return labels


def report_of(recognised: Recognised, labels: np.ndarray, classifier: Tells) -> RecognitionReport:
    """Count what was told of clips whose true classes are (n,) int64."""
    classes, names = list(classifier.classes), recognised.modalities
    told = recognised.predicted
    whole, truth = torch.from_numpy(told[()]), torch.from_numpy(labels)
    f1 = multiclass_f1_score(whole, truth, num_classes=len(classes), average="none")
    known = np.union1d(told[()], labels)
    return RecognitionReport(
        target=classifier.target,
        classes=classes,
        clips=len(labels),
        scores=scores_of(told[()], labels, len(classes)),
        f1={name: float(f1[index]) if index in known else None for index, name in enumerate(classes)},
        confusion=multiclass_confusion_matrix(whole, truth, num_classes=len(classes)).tolist(),
        without={name: scores_of(told[(name,)], labels, len(classes)) for name in names if (name,) in told},
        only={
            name: scores_of(told[others(names, name)], labels, len(classes)).f1_macro
            for name in names
            if len(names) > 1
        },
        attention=_mean_attention(recognised),
        perplexity={
            name: found for name, codes in recognised.codes.items() if (found := _perplexity(codes)) is not None
        },
    )


def scores_of(predicted: np.ndarray, labels: np.ndarray, classes: int) -> Scores:
    """The four scores of (n,) predicted and true classes."""
    pair = torch.from_numpy(predicted), torch.from_numpy(labels)
    macro, micro, weighted = (
        float(multiclass_f1_score(*pair, num_classes=classes, average=average))
        for average in ("macro", "micro", "weighted")
    )
    return Scores(macro, micro, weighted, float(multiclass_accuracy(*pair, num_classes=classes, average="micro")))


def _perplexity(codes: np.ndarray) -> float | None:
    """Mean over the groups of (n, G) codes; -1 stands for what was missing. None where all of it is."""
    there = codes[(codes >= 0).all(1)]
    return float(np.mean([2.0 ** entropy(group) for group in there.T])) if len(there) else None


def _mean_attention(recognised: Recognised) -> dict[str, float]:
    weights = recognised.attention.get("modalities")
    if weights is None:
        return {}
    mean = weights[weights.sum(1) > 0].mean(0) if weights.any() else np.zeros(weights.shape[1])
    return dict(zip(recognised.modalities, map(float, mean), strict=True))
