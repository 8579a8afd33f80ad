"""Decoders: (N, M) in, a picture out.

``DECODERS`` maps the class names that bundles and configurations may use to the classes.
"""

from repdib_lightning.decoders.base import Decoder
from repdib_lightning.decoders.residual_blocks import ResidualDecoder

DECODERS: dict[str, type[Decoder]] = {ResidualDecoder.__name__: ResidualDecoder}

__all__ = ["DECODERS", "Decoder", "ResidualDecoder"]
