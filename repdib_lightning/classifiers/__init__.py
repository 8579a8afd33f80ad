"""Classifiers: (N, M) in, a number for each class of the data's target out.

``CLASSIFIERS`` maps the class names that bundles and configurations may use to the classes.
"""

from repdib_lightning.classifiers.base import Classifier
from repdib_lightning.classifiers.linear import LinearClassifier
from repdib_lightning.classifiers.mlp import MLPClassifier

CLASSIFIERS: dict[str, type[Classifier]] = {cls.__name__: cls for cls in (LinearClassifier, MLPClassifier)}

__all__ = ["CLASSIFIERS", "Classifier", "LinearClassifier", "MLPClassifier"]
