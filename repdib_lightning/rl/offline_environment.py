"""The environment in which an offline agent is evaluated: by default the one its data were recorded in."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any

from repdib_lightning.data.episodes import EpisodeStore
from repdib_lightning.errors import UserError
from repdib_lightning.rl.offline_options import NO_ENVIRONMENT

CONTROL, ATARI = "repdib/Control-v0", "repdib/Atari-v0"
_SHORT = {"Control": CONTROL, "Atari": ATARI}
_VD4RL = "dm_control/"

_FIXED = {
    CONTROL: ("task", "action_repeat", "image_size", "distractor_seed"),
    ATARI: ("game", "frame_skip", "image_size", "side", "side_width", "distractor_seed"),
}
"""Of a recording; evaluated otherwise, its return would be that of another problem, or amid clips that were seen."""

_TAKEN = ("task", "action_repeat", "image_size", "quality", "distractors", "place", "source")
_TAKEN_OF_ATARI = (
    "game",
    "image_size",
    "frame_skip",
    "sticky",
    "noop_max",
    "max_frames",
    "side",
    "side_width",
    "side_source",
)


def evaluated_environment(
    store: EpisodeStore, env: str, options: Mapping[str, Any]
) -> tuple[str, dict[str, Any]] | None:
    """Which environment to open, and its options; None for no evaluation.

    Args:
        store: the data. env: a gymnasium id, ``none``, or empty for the data's own. options: over the data's own.

    Raises:
        UserError: the data do not tell where they were recorded, or an option that differs from what they were
            recorded with.
    """
    if env == NO_ENVIRONMENT:
        if options:
            raise UserError("--env_options mean nothing with --env none; leave one of them out")
        return None
    recorded_in, recorded = recorded_environment(store)
    if env and (_SHORT.get(env, env) != recorded_in or recorded is None):
        held_out = {"evaluation": True} if _SHORT.get(env, env) in _FIXED else {}
        return env, {**held_out, **options}
    if recorded is None:
        raise UserError(
            f"{store.path}: does not tell in which environment it was recorded; name one with --env, or train without "
            "evaluation with --env none"
        )
    for name in _FIXED[recorded_in]:
        if name in options and name in recorded and _spelled(options[name]) != _spelled(recorded[name]):
            raise UserError(
                f"--env_options.{name} {options[name]}: {store.path} was recorded with {recorded[name]}; leave it out, "
                "or collect other data"
            )
    chosen = {"evaluation": True, **recorded, **options}
    if chosen.get("distractors") == "none":  # what was recorded of them means nothing then
        chosen = {name: value for name, value in chosen.items() if name in options or name not in ("place", "source")}
    return recorded_in, chosen


def _spelled(option: Any) -> Any:
    """``walker_walk`` and ``walker-walk`` are the same task; ``MsPacman`` and ``ms_pacman`` the same game."""
    return option.lower().replace("_", "").replace("-", "") if isinstance(option, str) else option


def recorded_environment(store: EpisodeStore) -> tuple[str, dict[str, Any] | None]:
    """Where a store was recorded, and the options there; an empty name and None where it does not tell."""
    if str(store.attributes.get("environment", "")) == "atari" and "configuration" in store.attributes:
        configuration = json.loads(store.attributes["configuration"])
        found = {name: configuration[name] for name in _TAKEN_OF_ATARI if name in configuration}
        drawn = {"distractor_seed": configuration["seed"]} if "seed" in configuration else {}
        return ATARI, {**found, **drawn}
    recorded = recorded_options(store)
    return ("" if recorded is None else CONTROL), recorded


def recorded_options(store: EpisodeStore) -> dict[str, Any] | None:
    """Options of :class:`ControlEnv` that a store of the Control Suite was recorded with; None for any other."""
    environment = str(store.attributes.get("environment", ""))
    if environment == "control" and "configuration" in store.attributes:
        configuration = json.loads(store.attributes["configuration"])
        found = {name: configuration[name] for name in _TAKEN}
        return {**found, "distractor_seed": configuration["seed"]}
    published = str(store.attributes.get("vd4rl_set", "main/"))  # the others change the scene or the body
    if environment.startswith(_VD4RL) and published.startswith("main/"):
        shape = next(iter(store.observations.values())).shape
        task = environment.removeprefix(_VD4RL)
        return {"task": task, "action_repeat": 2, "image_size": shape[-1], "quality": "paper"}
    return None
