"""What is written below a frame: the action taken at it and its factors, by the names of their classes."""

from __future__ import annotations

import json
from typing import Any

import numpy as np

from repdib_lightning.data.episodes import EpisodeStore
from repdib_lightning.data.inspection_text import short_number

_MOST_FACTORS = 8


def channel_names(store: EpisodeStore, name: str) -> list[str]:
    """What the attribute ``channels`` calls each channel of an observation; their numbers where it has no such list."""
    width = store.observations[name].shape[-1]
    named = _stated(store, "channels").get(name)
    return [str(channel) for channel in (named if isinstance(named, list) and len(named) == width else range(width))]


def rate_of(store: EpisodeStore, name: str) -> float | None:
    """Steps a second of an observation, as the attribute ``rate`` has it; None where it has none."""
    rate = _stated(store, "rate").get(name)
    return float(rate) if isinstance(rate, (int, float)) and rate > 0 else None


def _stated(store: EpisodeStore, attribute: str) -> dict[str, Any]:
    """An attribute that holds a dictionary as JSON; empty where another program wrote anything else there."""
    try:
        stated = json.loads(str(store.attributes.get(attribute, "{}")))
    except ValueError:
        return {}
    return stated if isinstance(stated, dict) else {}


def captions(store: EpisodeStore, rows: np.ndarray, *, actions: bool) -> list[list[str]]:
    """Lines below each of some frames, the agent's own factors first; at most eight factors, and how many more.

    Args:
        store: where the rows live.
        rows: (n,) int64.
        actions: whether to begin with the action, if the store has any.

    Returns:
        As many lists as rows, with equally many lines.
    """
    names = store.class_names
    factors = sorted(store.factors, key=lambda name: (store.factors[name].kind, name))
    columns = {}
    if actions and store.actions_spec is not None:
        final = np.isin(rows, store.starts + store.lengths - 1)
        taken = _shown(store, "actions", rows, names.get("actions"))
        columns["action"] = ["none (last)" if last else text for last, text in zip(final, taken, strict=True)]
    for name in factors[:_MOST_FACTORS]:
        columns[name] = _shown(store, f"factors/{name}", rows, names.get(name))
    more = [f"and {len(factors) - _MOST_FACTORS} more"] if len(factors) > _MOST_FACTORS else []
    return [[f"{name}  {texts[i]}" for name, texts in columns.items()] + more for i in range(len(rows))]


def _shown(store: EpisodeStore, key: str, rows: np.ndarray, names: list[str] | None) -> list[str]:
    values = store.gather(key, rows).reshape(len(rows), -1)
    if names is not None:  # a final row's action stands for nothing, and may be any number
        numbers = values[:, 0].tolist()
        return [names[number] if 0 <= number < len(names) else str(number) for number in numbers]
    return [
        short_number(value[0]) if len(value) == 1 else " ".join(f"{number:.2g}" for number in value) for value in values
    ]
