"""Self-supervised objectives."""

from repdib_lightning.objectives.base import Encode, Objective
from repdib_lightning.objectives.driml import DRIML
from repdib_lightning.objectives.info_nce import InfoNCE
from repdib_lightning.objectives.inverse_dynamics import InverseDynamics

OBJECTIVES: dict[str, type[Objective]] = {cls.__name__: cls for cls in (InverseDynamics, DRIML, InfoNCE)}
"""The objectives by name."""

__all__ = ["DRIML", "OBJECTIVES", "Encode", "InfoNCE", "InverseDynamics", "Objective"]
