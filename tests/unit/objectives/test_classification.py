"""Classification: the loss of a slow loop, the anchor alone, and the scores of all samples rather than of batches."""

from __future__ import annotations

import math

import pytest
import torch
from sklearn.metrics import accuracy_score, confusion_matrix, f1_score

from repdib_lightning.classifiers import MLPClassifier
from repdib_lightning.errors import UserError
from repdib_lightning.objectives import Classification, ForwardPrediction, SeveralObjectives
from repdib_lightning.objectives.classification import class_metrics
from repdib_lightning.records import ActionSpec, ArraySpec, Batch, DataSpec

SPEC = DataSpec(
    {"pulse": ArraySpec((5, 2), "float32")},
    ActionSpec("discrete", 3),
    target="activity",
    classes=("run", "sit", "walk"),
)


def batch(count=6, frames=1, targets=True):
    offsets = torch.arange(frames).repeat(count, 1)
    classes = torch.arange(count) % 3 if targets else None
    return Batch(
        {"pulse": torch.zeros(count, frames, 5, 2)}, torch.zeros(count).long(), offsets, offsets[:, 0], classes
    )


@pytest.mark.parametrize("smoothing", [0.0, 0.2])
def test_loss_and_accuracy_are_those_of_a_slow_loop(smoothing):
    torch.manual_seed(0)
    objective = Classification(7, SPEC, label_smoothing=smoothing)
    latents = torch.randn(6, 2, 7)
    output = objective(batch(6, 2), lambda _: latents)
    total, right = 0.0, 0
    for i in range(6):
        scores = objective.classifier(latents[i, :1])[0].tolist()
        whole = math.log(sum(math.exp(score) for score in scores))
        for name, score in enumerate(scores):
            wanted = smoothing / 3 + (1.0 - smoothing) * (name == i % 3)
            total -= wanted * (score - whole)
        right += scores.index(max(scores)) == i % 3
    assert output.losses["classification"].item() == pytest.approx(total / 6, rel=1e-5)
    assert float(output.metrics["accuracy"]) == pytest.approx(right / 6)


def test_the_scores_are_those_of_all_samples_whatever_the_batches():
    generator = torch.Generator().manual_seed(0)
    true = torch.randint(0, 4, (101,), generator=generator)
    told = torch.where(
        torch.rand(101, generator=generator) < 0.5, true, torch.randint(0, 5, (101,), generator=generator)
    )
    metrics = class_metrics(7)  # classes 5 and 6 neither occur nor are predicted, 4 is only predicted
    for part_told, part_true in zip(told.split(30), true.split(30), strict=True):
        metrics.update(part_told, part_true)
    found = metrics.compute()
    for average in ("macro", "micro", "weighted"):
        assert float(found[f"f1_{average}"]) == pytest.approx(f1_score(true, told, average=average), abs=1e-6)
    assert float(found["accuracy"]) == pytest.approx(accuracy_score(true, told))
    assert found["confusion"].tolist() == confusion_matrix(true, told, labels=range(7)).tolist()


def test_a_part_of_several_hands_on_its_scores_and_its_classifier():
    spec = DataSpec(SPEC.observations, SPEC.actions, target="activity", classes=SPEC.classes)
    several = SeveralObjectives(7, spec, parts=[ForwardPrediction, Classification])
    latents = torch.randn(6, 2, 7)
    output = several(batch(6, 2), lambda _: latents)
    assert {"forward", "classification"} <= set(output.losses)
    assert set(output.updates) == set(several.held_out_metrics()) == {"classes"}
    assert several.find_classifier() == ("parts.1.classifier", several.parts[1].classifier)
    assert several.parts[0].held_out_metrics() == {} and several.parts[0].find_classifier() is None


@pytest.mark.parametrize(
    ("make", "complaint"),
    [
        (lambda: Classification(7, DataSpec(SPEC.observations)), "set data.target to a categorical factor"),
        (lambda: Classification(7, SPEC, label_smoothing=1.5), "label_smoothing must be in 0..1, is 1.5"),
        (lambda: Classification(7, SPEC, classifier=lambda s, w: MLPClassifier(s, w, hidden=-1)), "hidden must be"),
        (lambda: Classification(7, SPEC)(batch(targets=False), lambda _: torch.zeros(6, 1, 7)), "have no classes"),
    ],
)
def test_what_cannot_be_is_one_line(make, complaint):
    with pytest.raises(UserError, match=complaint):
        make()
