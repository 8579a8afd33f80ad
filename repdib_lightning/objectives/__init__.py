"""Self-supervised objectives."""

from repdib_lightning.objectives.base import Encode, Objective
from repdib_lightning.objectives.inverse_dynamics import InverseDynamics

OBJECTIVES: dict[str, type[Objective]] = {cls.__name__: cls for cls in (InverseDynamics,)}
"""The objectives by name."""

__all__ = ["OBJECTIVES", "Encode", "InverseDynamics", "Objective"]
