"""Encoders: a dictionary of observations in, (N, M) out."""

from repdib_lightning.encoders.augmentation import random_shift
from repdib_lightning.encoders.base import Encoder, EncoderOutput
from repdib_lightning.encoders.convolutional import ConvolutionalEncoder
from repdib_lightning.encoders.multimodal import MultimodalEncoder
from repdib_lightning.encoders.residual_blocks import ResidualEncoder
from repdib_lightning.encoders.resnet import ResNetEncoder

ENCODERS: dict[str, type[Encoder]] = {
    cls.__name__: cls for cls in (ConvolutionalEncoder, ResNetEncoder, ResidualEncoder, MultimodalEncoder)
}
"""The encoders that a bundle may name."""

__all__ = [
    "ENCODERS",
    "ConvolutionalEncoder",
    "Encoder",
    "EncoderOutput",
    "MultimodalEncoder",
    "ResNetEncoder",
    "ResidualEncoder",
    "random_shift",
]
