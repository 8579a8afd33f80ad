"""Opens the copies of an environment in which an offline agent is evaluated, one for each episode."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, TypeVar

import gymnasium

from repdib_lightning.errors import UserError
from repdib_lightning.records import ActionSpec, DataSpec
from repdib_lightning.rl.environment import open_environment
from repdib_lightning.rl.episodes_at_once import EpisodesAtOnce

Episodes = TypeVar("Episodes", bound=EpisodesAtOnce)


def open_episodes(
    kind: type[Episodes],
    chosen: tuple[str, Mapping[str, Any]],
    actions: ActionSpec,
    spec: DataSpec,
    *,
    count: int,
    seed: int,
    whose: str,
) -> Episodes:
    """Open what plays the episodes of an evaluation.

    Args:
        kind: of them. chosen: the environment and its options. actions: of the data. spec: of the encoder.
        count: episodes. seed: of them. whose: option that brought the spec, for the error.

    Raises:
        UserError: no such environment, bad options, other actions than the data's, or other observations than the
            encoder's; nothing stays open then.
    """
    copies = open_copies(*chosen, count, actions)
    try:
        return kind(copies, spec, seed)
    except UserError as error:
        _close(copies)
        raise UserError(f"{whose}: does not fit --env {chosen[0]}: {error}") from error


def open_copies(
    name: str, options: Mapping[str, Any], count: int, actions: ActionSpec
) -> list[gymnasium.Env[Any, Any]]:
    """Open copies of an environment whose actions are those of the data.

    Raises:
        UserError: no such environment, bad options, or other actions; nothing stays open then.
    """
    opened: list[gymnasium.Env[Any, Any]] = []
    try:
        for _ in range(count):
            opened.append(open_environment(name, options))
            _check_actions(name, opened[-1].action_space, actions)
    except BaseException:
        _close(opened)
        raise
    return opened


def _check_actions(name: str, space: gymnasium.Space[Any], actions: ActionSpec) -> None:
    if actions.kind == "continuous":
        if not isinstance(space, gymnasium.spaces.Box) or space.shape != (actions.size,):
            wanted = f"those of the data are continuous, {actions.size} wide"
            raise UserError(f"--env {name}: its actions are {space}, {wanted}")
        return
    wanted = f"the data have {actions.size} discrete ones"
    if not isinstance(space, gymnasium.spaces.Discrete):
        raise UserError(f"--env {name}: has no discrete actions but {space}, {wanted}")
    if space.n != actions.size:
        raise UserError(f"--env {name}: has {space.n} actions, {wanted}")


def _close(copies: list[gymnasium.Env[Any, Any]]) -> None:
    for copy in copies:
        copy.close()
