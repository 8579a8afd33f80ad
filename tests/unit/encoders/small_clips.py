"""Small clips that the tests of clip encoders share."""

from __future__ import annotations

import torch

from repdib_lightning.records import ArraySpec, DataSpec

FRAMES, READINGS = 6, 20


def sensor(channels, readings=READINGS):
    return ArraySpec((readings, channels), "float32", (1.0,) * channels, (2.0,) * channels)


SPEC = DataSpec(
    {
        "cam1": ArraySpec((FRAMES, 3, 16, 16)),
        "cam2": ArraySpec((FRAMES, 1, 20, 24)),
        "acceleration": sensor(6),
        "gyroscope": sensor(3),
        "orientation": sensor(3),
        "features": ArraySpec((FRAMES, 10), "float32"),
    },
    horizon=0,
    target="activity",
    classes=("sit", "run"),
)
SMALL = {
    "features": 12,
    "width": 8,
    "segments": 3,
    "channels": 7,
    "angles": ["orientation"],
    "frame_features": ["features"],
}
REPDIB = {"bottleneck": "RepDIB", "bottleneck_options": {"groups": 2, "codes": 4, "start_step": 1, "revive_after": 2}}


def clips(count=5, seed=0, spec=SPEC):
    generator = torch.Generator().manual_seed(seed)
    drawn = {}
    for name, array in spec.observations.items():
        shape = (count, *array.shape)
        if array.is_video:
            drawn[name] = torch.randint(1, 256, shape, dtype=torch.uint8, generator=generator)
        else:
            drawn[name] = torch.randn(shape, generator=generator) * 3
    return drawn


def missing(array):
    """The same array with everything missing."""
    return torch.zeros_like(array) if array.dtype == torch.uint8 else torch.full_like(array, torch.nan)
