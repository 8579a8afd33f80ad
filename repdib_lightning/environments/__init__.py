"""Environments: where data sets come from. Importing this package imports no simulator."""

from __future__ import annotations

from typing import Any

from repdib_lightning.environments.urlb_tasks import URLB_TASKS, gymnasium_name

COLLECTORS = {
    "activities": "repdib_lightning.environments.collect_activities:collect_activities",
    "atari": "repdib_lightning.environments.collect_atari:collect_atari",
    "atari_policy": "repdib_lightning.environments.train_atari_policy:train_atari_policy",
    "control": "repdib_lightning.environments.collect_control:collect_control",
    "emoji_styles": "repdib_lightning.environments.collect_emoji_styles:collect_emoji_styles",
    "maze": "repdib_lightning.environments.collect_maze:collect_maze",
    "policies": "repdib_lightning.environments.train_policies:train_policies",
    "robot_arm": "repdib_lightning.environments.collect_robot_arm:collect_robot_arm",
    "shapes": "repdib_lightning.environments.collect_shapes:collect_shapes",
    "smartwatch": "repdib_lightning.environments.collect_smartwatch:collect_smartwatch",
}
"""Environment -> ``module:function`` that records a data set of it: ``function(path, *, seed, overwrite, ...)``."""

_MAZES = ("GridWorld", "SpiralWorld", "LoopWorld")
_CHOSEN: dict[str, dict[str, Any]] = {
    **{f"repdib/{world}-v0": {"world": world} for world in _MAZES},
    **{
        f"repdib/{gymnasium_name(task)}-v0": {"world": task, "image_size": 84, "action_repeat": 2, "frame_stack": 3}
        for task in URLB_TASKS
    },
}
"""Identifier -> arguments that differ from the constructor's defaults; of URLB's tasks, URLB's."""

GYMNASIUM_IDS = {
    **{f"repdib/{world}-v0": "repdib_lightning.environments.maze_env:MazeEnv" for world in _MAZES},
    **{
        f"repdib/{gymnasium_name(task)}-v0": "repdib_lightning.environments.control_env:ControlEnv"
        for task in URLB_TASKS
    },
    "repdib/Atari-v0": "repdib_lightning.environments.atari_env:AtariEnv",
    "repdib/Control-v0": "repdib_lightning.environments.control_env:ControlEnv",
    "repdib/RobotArm-v0": "repdib_lightning.environments.robot_arm_env:RobotArmEnv",
}
"""Identifier for ``gymnasium.make`` -> class; see :func:`register`."""

_VECTORISED = {f"repdib/{world}-v0": "repdib_lightning.environments.maze_vector_env:MazeVectorEnv" for world in _MAZES}


def register() -> None:
    """Make the package's environments known to ``gymnasium.make``; calling it again changes nothing.

    It has to be asked for, since importing this package has no side effects.
    """
    import gymnasium

    for name, entry_point in GYMNASIUM_IDS.items():
        if name not in gymnasium.registry:
            chosen = dict(_CHOSEN.get(name, {}))
            gymnasium.register(name, entry_point=entry_point, vector_entry_point=_VECTORISED.get(name), kwargs=chosen)
