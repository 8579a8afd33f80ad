"""Classifiers: one number for each class, rebuilt from what they remember, dropout in training only."""

from __future__ import annotations

import pytest
import torch

from repdib_lightning.classifiers import CLASSIFIERS, LinearClassifier, MLPClassifier
from repdib_lightning.errors import UserError
from repdib_lightning.records import ArraySpec, DataSpec

SPEC = DataSpec({"pulse": ArraySpec((5, 2), "float32")}, target="activity", classes=("run", "sit", "walk"))


@pytest.mark.parametrize("kind", CLASSIFIERS.values())
def test_one_number_for_each_class_from_a_classifier_that_can_be_rebuilt(kind):
    built = kind(SPEC, 7, dropout=0.3).eval()
    again = kind(SPEC, 7, **built.arguments).eval()
    again.load_state_dict(built.state_dict())
    latents = torch.randn(4, 7)
    assert built(latents).shape == (4, 3) and torch.equal(built(latents), again(latents))
    assert (built.target, built.classes) == ("activity", ("run", "sit", "walk"))


@pytest.mark.parametrize("kind", CLASSIFIERS.values())
def test_dropout_is_of_training_alone_and_keeps_the_mean(kind):
    torch.manual_seed(0)
    built = kind(SPEC, 64, dropout=0.5)
    latents = torch.rand(2000, 64) + 1.0
    dropped = built.layers[0](latents)
    share = (dropped == 0).float().mean()
    assert abs(share - 0.5) < 0.02 and torch.allclose(dropped.mean(), latents.mean(), rtol=0.02)
    kept = dropped != 0
    assert torch.equal(dropped[kept], 2.0 * latents[kept])
    assert torch.equal(built.eval().layers[0](latents), latents)


def test_the_hidden_layer_is_not_linear():
    torch.manual_seed(0)
    built = MLPClassifier(SPEC, 4, hidden=8)
    a, b = torch.randn(2, 5, 4)
    assert not torch.allclose(built(a) + built(b), built(a + b) + built(torch.zeros(5, 4)), atol=1e-4)


@pytest.mark.parametrize(
    ("build", "complaint"),
    [
        (lambda: LinearClassifier(DataSpec(SPEC.observations), 4), "LinearClassifier: .*set data.target"),
        (lambda: MLPClassifier(DataSpec({}, target="x", classes=("a",)), 4), "'x' has 1 classes"),
        (lambda: LinearClassifier(SPEC, 4, dropout=1.0), "LinearClassifier: dropout must be at least 0 and below 1"),
        (lambda: MLPClassifier(SPEC, 4, dropout=-0.1), "MLPClassifier: dropout"),
        (lambda: MLPClassifier(SPEC, 4, hidden=0), "hidden must be at least 1, is 0"),
    ],
)
def test_what_cannot_be_is_one_line(build, complaint):
    with pytest.raises(UserError, match=complaint):
        build()
