"""URLB's walker that turns somersaults (Laskin et al. 2021), on the Control Suite's planar walker.

Import it after ``control_task.load_suite``, which chooses the renderer that dm_control opens.
"""

from __future__ import annotations

from typing import Any

from dm_control.rl import control
from dm_control.suite import walker
from dm_control.utils import rewards

from repdib_lightning.environments.urlb_tasks import Loaded

_SECONDS, _INTERVAL = 25, 0.025
_SPIN = 5.0
"""Angular momentum (kg m^2/s) from which on the whole reward is given."""


class Flip(walker.PlanarWalker):
    """Stand high and upright while turning forward.

    The reward is the suite's reward for standing, times (5 s + 1) / 6, where s rises linearly from 0 to 1 as the
    angular momentum about the lateral axis does from 0 to 5.
    """

    def __init__(self) -> None:
        super().__init__(move_speed=0, random=0)  # at speed 0 the suite's reward is that of standing

    def get_reward(self, physics: Any) -> float:
        """Reward of the moment, 0 to 1."""
        momentum = physics.named.data.subtree_angmom["torso", "y"]
        spin = rewards.tolerance(momentum, (_SPIN, float("inf")), margin=_SPIN, value_at_margin=0, sigmoid="linear")
        return super().get_reward(physics) * (5 * spin + 1) / 6


def load(task: str) -> Loaded:
    """Load ``flip``."""
    assert task == "flip"
    physics = walker.Physics.from_xml_string(*walker.get_model_and_assets())
    environment = control.Environment(physics, Flip(), time_limit=_SECONDS, control_timestep=_INTERVAL)
    return Loaded.of_suite(environment)
