"""Finds and opens the environment that a user names."""

from __future__ import annotations

import importlib
from collections.abc import Mapping
from typing import Any, get_args, get_type_hints

import gymnasium

from repdib_lightning.environments import GYMNASIUM_IDS, register
from repdib_lightning.environments.maze_env import MazeEnv
from repdib_lightning.errors import UserError, nearest


def open_environment(name: str, options: Mapping[str, Any]) -> gymnasium.Env[Any, Any]:
    """Open an environment of this package by its short name (``SpiralWorld``), or any by its gymnasium id.

    Raises:
        UserError: no such environment, or options it does not take.
    """
    register()
    short = {known.removeprefix("repdib/").partition("-")[0]: known for known in GYMNASIUM_IDS}
    wanted = short.get(name, name)
    if wanted not in gymnasium.registry:
        raise UserError(f"--env {name}: no such environment, {nearest(name, [*short, *_alike(name)])}")
    if wanted in GYMNASIUM_IDS:
        _check_options(name, GYMNASIUM_IDS[wanted], options)
    try:
        environment = gymnasium.make(wanted, **options)
    except UserError as error:
        raise UserError(f"--env {name}: {error}") from error
    except Exception as error:  # whatever the constructors of other packages raise
        raise UserError(f"--env {name}: {(str(error) or type(error).__name__).splitlines()[0]}") from error
    return environment


def check_discrete(name: str, environment: gymnasium.Env[Any, Any], agent: str) -> None:
    """Raise UserError unless the actions of an environment are discrete, as an agent needs them."""
    if not isinstance(environment.action_space, gymnasium.spaces.Discrete):
        raise UserError(f"--env {name}: {agent} needs discrete actions, these are {environment.action_space}")


def maze_of(environment: gymnasium.Env[Any, Any]) -> MazeEnv | None:
    """The maze inside all wrappers, or None for any other environment."""
    inner = environment.unwrapped
    return inner if isinstance(inner, MazeEnv) else None


def _check_options(name: str, place: str, options: Mapping[str, Any]) -> None:
    """Of our own environments: their arguments and nothing else, plain ones of the type that they state."""
    module, _, built = place.partition(":")
    kinds = get_type_hints(getattr(importlib.import_module(module), built).__init__)
    # The world is that of the name, and nothing here looks at what is rendered.
    known = [option for option in kinds if option not in ("world", "render_mode", "return")]
    for option, value in options.items():
        if option not in known:
            raise UserError(f"--env_options.{option}: no option of {name}, {nearest(option, known)}")
        allowed = get_args(kinds[option]) or (kinds[option],)
        if {*allowed} <= {int, bool, str, type(None)} and type(value) not in allowed:
            wanted = " or ".join(kind.__name__ for kind in allowed if kind is not type(None))
            raise UserError(f"--env_options.{option}: expected {wanted}, got '{value}'")


def _alike(name: str) -> list[str]:
    """Ids that are known to gymnasium and begin as the name does; all of them would bury ours."""
    return [known for known in gymnasium.registry if known.lower().startswith(name.lower()[:4])][:5]
