"""Bottlenecks: the slot between an encoder and an objective.

``BOTTLENECKS`` maps the class names that bundles and configurations may use to the classes.
"""

from repdib_lightning.bottlenecks.base import Bottleneck
from repdib_lightning.bottlenecks.identity import Identity
from repdib_lightning.bottlenecks.per_position import PerPosition, for_positions
from repdib_lightning.bottlenecks.repdib import RepDIB
from repdib_lightning.bottlenecks.svib import SVIB
from repdib_lightning.bottlenecks.variational import Variational
from repdib_lightning.bottlenecks.vector_quantiser import VectorQuantiser

BOTTLENECKS: dict[str, type[Bottleneck]] = {
    kind.__name__: kind for kind in (Identity, Variational, VectorQuantiser, RepDIB, SVIB)
}

__all__ = [
    "BOTTLENECKS",
    "SVIB",
    "Bottleneck",
    "Identity",
    "PerPosition",
    "RepDIB",
    "Variational",
    "VectorQuantiser",
    "for_positions",
]
