"""URLB's quadruped that stands, and that jumps (Laskin et al. 2021), on the Control Suite's quadruped.

Import it after ``control_task.load_suite``, which chooses the renderer that dm_control opens.
"""

from __future__ import annotations

from typing import Any

from dm_control.rl import control
from dm_control.suite import common, quadruped
from dm_control.utils import rewards

from repdib_lightning.environments.urlb_tasks import Loaded

_SECONDS, _INTERVAL = 20, 0.02
_FLOOR = 10.0
"""Half the width of the floor in metres."""

_HEIGHT = 1.0
"""Of the centre of mass, in metres, from which on the whole reward is given."""


class Stand(quadruped.Move):
    """Hold the torso upright: reward (1 + z) / 2, z the vertical part of the torso's own upward axis."""

    def __init__(self) -> None:
        super().__init__(desired_speed=0, random=0)  # of Move, only the starts and observations are used

    def get_reward(self, physics: Any) -> float:
        """Reward of the moment, 0 to 1."""
        return rewards.tolerance(
            physics.torso_upright(), (1.0, float("inf")), margin=2.0, value_at_margin=0, sigmoid="linear"
        )


class Jump(Stand):
    """Lift the centre of mass: the reward of standing, times 1 at a height of 1 m and 0.5 at 0 m, linear between."""

    def get_reward(self, physics: Any) -> float:
        """Reward of the moment, 0 to 1."""
        height = physics.named.data.sensordata["center_of_mass"][2]
        lifted = rewards.tolerance(
            height, (_HEIGHT, float("inf")), margin=_HEIGHT, value_at_margin=0.5, sigmoid="linear"
        )
        return super().get_reward(physics) * lifted


def load(task: str) -> Loaded:
    """Load ``stand`` or ``jump``."""
    physics = quadruped.Physics.from_xml_string(quadruped.make_model(floor_size=_FLOOR), common.ASSETS)
    goal = {"stand": Stand, "jump": Jump}[task]()
    environment = control.Environment(physics, goal, time_limit=_SECONDS, control_timestep=_INTERVAL)
    return Loaded.of_suite(environment)
