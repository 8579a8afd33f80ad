"""What a store that is made of another one keeps of it."""

from __future__ import annotations

import json
from collections.abc import Sequence
from typing import Any

import numpy as np

from repdib_lightning.data.episodes import EpisodeStore
from repdib_lightning.errors import UserError

_SET_BY_WRITER = ("format", "schema_version", "fingerprint")
_OUTCOME = ("rewards", "terminations", "truncations")


def kept_attributes(store: EpisodeStore, without: Sequence[str] = ()) -> dict[str, Any]:
    """Attributes of the file as the writer takes them: numbers and text as they are, arrays as lists."""
    left_out = (*_SET_BY_WRITER, *without)
    return {key: _plain(value) for key, value in store.attributes.items() if key not in left_out}


def _plain(value: Any) -> Any:
    if isinstance(value, np.ndarray):
        return value.tolist()
    if isinstance(value, bytes):
        return value.decode(errors="replace")
    return value if isinstance(value, (str, int, float, bool)) else json.loads(json.dumps(value, default=str))


def kept_statement(store: EpisodeStore) -> dict[str, Any]:
    """Arguments of a writer whose store has the same rows, episodes, actions, factors, outcome and recordings.

    Raises:
        UserError: the store has some of rewards and ends of episodes only.
    """
    outcome = [name for name in _OUTCOME if name in store]
    if outcome and len(outcome) < len(_OUTCOME):
        missing = next(name for name in _OUTCOME if name not in store)
        raise UserError(
            f"{store.path}: has '{outcome[0]}' but no '{missing}'; a store has all of {', '.join(_OUTCOME)}, or none"
        )
    return {
        "rows": store.rows,
        "episodes": len(store.starts),
        "actions": store.actions_spec,
        "factors": store.factors,
        "rewards": bool(outcome),
        "recordings": "episodes/recording" in store,
    }


def kept_of_episode(store: EpisodeStore, episode: int) -> dict[str, Any]:
    """All but the observations and masks of an episode, as the writer takes it."""
    rows = episode_rows(store, episode)
    kept: dict[str, Any] = {
        "evaluation": bool(store.held_out_episodes[episode]),
        "recording": store.recording_of(episode),
        "factors": {name: store.gather(f"factors/{name}", rows) for name in store.factors},
    }
    if store.actions_spec is not None:
        kept["actions"] = store.gather("actions", rows[:-1])
    return kept | {name: store.gather(name, rows[:-1]) for name in _OUTCOME if name in store}


def episode_rows(store: EpisodeStore, episode: int) -> np.ndarray:
    """(T,) int64: the rows of an episode."""
    return np.arange(store.starts[episode], store.starts[episode] + store.lengths[episode])
