"""URLB's arm that reaches for a brick (Laskin et al. 2021), on dm_control's own reaching task.

Import it after ``control_task.load_suite``, which chooses the renderer that dm_control opens.
"""

from __future__ import annotations

import numpy as np
from dm_control import composer
from dm_control.entities import props
from dm_control.manipulation import reach
from dm_control.manipulation.shared import arenas, observations, robots, workspaces

from repdib_lightning.environments.urlb_tasks import Loaded

_INTERVAL, _STEPS = 0.04, 250
_STARTS_TRIED = 10
_ABOVE_FLOOR = 0.001
_BRICKS = {
    "reach_top_left": (-0.09, 0.09, _ABOVE_FLOOR),
    "reach_top_right": (0.09, 0.09, _ABOVE_FLOOR),
    "reach_bottom_left": (-0.09, -0.09, _ABOVE_FLOOR),
    "reach_bottom_right": (0.09, -0.09, _ABOVE_FLOOR),
}
"""Task -> where the brick is put down, in metres."""

_FINGERS = workspaces.BoundingBox((-0.1, -0.1, 0.2), (0.1, 0.1, 0.4))
"""Where the point between the fingers is when an episode begins, in metres."""


def load(task: str) -> Loaded:
    """Load ``reach_top_left``, ``reach_top_right``, ``reach_bottom_left`` or ``reach_bottom_right``.

    The reward is dm_control's: 1 up to 5 cm between fingers and brick, falling to 0.1 at 10 cm. All is observed but
    pictures: composer would draw them at full quality.
    """
    brick, seen = _BRICKS[task], observations.PERFECT_FEATURES
    goal = reach.Reach(
        arena=arenas.Standard(),
        arm=robots.make_arm(seen),
        hand=robots.make_hand(seen),
        prop=props.Duplo(observable_options=observations.make_options(seen, observations.FREEPROP_OBSERVABLES)),
        obs_settings=seen,  # adds the camera, and leaves it switched off
        workspace=reach._ReachWorkspace(workspaces.BoundingBox(brick, brick), _FINGERS, robots.ARM_OFFSET),
        control_timestep=_INTERVAL,
    )
    random = np.random.RandomState(0)
    environment = composer.Environment(
        goal,
        time_limit=(_STEPS - 0.5) * _INTERVAL,  # half a step early: the sum of the time steps is not exact
        random_state=random,
        strip_singleton_obs_buffer_dim=True,
        max_reset_attempts=_STARTS_TRIED,
        recompile_mjcf_every_episode=False,
    )
    return Loaded(environment, random, _STEPS)
