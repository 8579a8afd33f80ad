"""What opens an environment in any process."""

from __future__ import annotations

from typing import Any

from repdib_lightning.environments.control_env import ControlEnv
from repdib_lightning.environments.rendering import prepare_rendering


class ControlFactory:
    """Opens environments of the Control Suite that are alike; pickles, so that worker processes open their own.

    Args:
        task, image_size, action_repeat, scene: of :class:`~repdib_lightning.environments.control_env.ControlEnv`.
    """

    def __init__(self, task: str, image_size: int, action_repeat: int, **scene: Any) -> None:
        self._options = {"task": task, "image_size": image_size, "action_repeat": action_repeat, **scene}

    def __call__(self) -> ControlEnv:
        """Open one, which draws in its own thread."""
        prepare_rendering(threads=0)
        return ControlEnv(**self._options)
