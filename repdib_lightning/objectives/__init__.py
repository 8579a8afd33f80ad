"""Objectives: self-supervised ones, and one that recognises a factor."""

from repdib_lightning.objectives.base import Encode, Objective
from repdib_lightning.objectives.classification import Classification
from repdib_lightning.objectives.driml import DRIML
from repdib_lightning.objectives.dynamic_bottleneck import DynamicBottleneck
from repdib_lightning.objectives.emi import EMI
from repdib_lightning.objectives.forward_prediction import ForwardPrediction
from repdib_lightning.objectives.info_nce import InfoNCE
from repdib_lightning.objectives.inverse_dynamics import InverseDynamics
from repdib_lightning.objectives.prototypes import Prototypes
from repdib_lightning.objectives.reconstruction import Reconstruction
from repdib_lightning.objectives.several import SeveralObjectives

OBJECTIVES: dict[str, type[Objective]] = {
    cls.__name__: cls
    for cls in (
        InverseDynamics,
        DRIML,
        InfoNCE,
        ForwardPrediction,
        EMI,
        DynamicBottleneck,
        Prototypes,
        Reconstruction,
        Classification,
        SeveralObjectives,
    )
}
"""The objectives by name."""

__all__ = [
    "DRIML",
    "EMI",
    "OBJECTIVES",
    "Classification",
    "DynamicBottleneck",
    "Encode",
    "ForwardPrediction",
    "InfoNCE",
    "InverseDynamics",
    "Objective",
    "Prototypes",
    "Reconstruction",
    "SeveralObjectives",
]
