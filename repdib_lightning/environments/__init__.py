"""Environments: where data sets come from. Importing this package imports no simulator."""

from __future__ import annotations

COLLECTORS = {"robot_arm": "repdib_lightning.environments.collect:collect_robot_arm"}
"""Environment -> ``module:function`` that records a data set of it: ``function(path, *, seed, overwrite, ...)``."""

GYMNASIUM_IDS = {"repdib/RobotArm-v0": "repdib_lightning.environments.robot_arm_env:RobotArmEnv"}
"""Identifier for ``gymnasium.make`` -> class; see :func:`register`."""


def register() -> None:
    """Make the package's environments known to ``gymnasium.make``; calling it again changes nothing.

    It has to be asked for, since importing this package has no side effects.
    """
    import gymnasium

    for name, entry_point in GYMNASIUM_IDS.items():
        if name not in gymnasium.registry:
            gymnasium.register(name, entry_point=entry_point)
