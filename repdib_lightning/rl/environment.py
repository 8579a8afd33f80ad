"""Finds and opens the environment that a user names."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import gymnasium

from repdib_lightning.environments import GYMNASIUM_IDS, register
from repdib_lightning.environments.maze_env import MazeEnv
from repdib_lightning.errors import UserError, nearest


def open_environment(name: str, options: Mapping[str, Any]) -> gymnasium.Env[Any, Any]:
    """Open an environment of this package by its short name (``SpiralWorld``), or any by its gymnasium id.

    Raises:
        UserError: no such environment, options it does not take, or actions that are not discrete.
    """
    register()
    short = {known.removeprefix("repdib/").partition("-")[0]: known for known in GYMNASIUM_IDS}
    wanted = short.get(name, name)
    if wanted not in gymnasium.registry:
        raise UserError(f"--env {name}: no such environment {nearest(name, [*short, *_alike(name)])}")
    try:
        environment = gymnasium.make(wanted, **options)
    except UserError as error:
        raise UserError(f"--env {name}: {error}") from error
    except (TypeError, gymnasium.error.Error) as error:
        raise UserError(f"--env {name}: {str(error).splitlines()[0]}") from error
    if not isinstance(environment.action_space, gymnasium.spaces.Discrete):
        raise UserError(f"--env {name}: DQN needs discrete actions, these are {environment.action_space}")
    return environment


def maze_of(environment: gymnasium.Env[Any, Any]) -> MazeEnv | None:
    """The maze inside all wrappers, or None for any other environment."""
    inner = environment.unwrapped
    return inner if isinstance(inner, MazeEnv) else None


def _alike(name: str) -> list[str]:
    """Ids that are known to gymnasium and begin as the name does; all of them would bury ours."""
    return [known for known in gymnasium.registry if known.lower().startswith(name.lower()[:4])][:5]
