"""Versions that a result depends on."""

from __future__ import annotations

import platform
from importlib.metadata import PackageNotFoundError, version
from typing import Any

_PACKAGES = (
    "repdib_lightning",
    "torch",
    "torchvision",
    "lightning",
    "numpy",
    "h5py",
    "mujoco",
    "dm_control",
    "scipy",
    "gymnasium",
    "stable_baselines3",
)


def versions() -> dict[str, Any]:
    """Versions of Python and of the packages that a result depends on."""
    found: dict[str, Any] = {"python": platform.python_version()}
    for name in _PACKAGES:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            continue
    return found
