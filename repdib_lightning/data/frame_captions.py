"""What is written below a frame: the action taken at it and its factors, by the names of their classes."""

from __future__ import annotations

import json

import numpy as np

from repdib_lightning.data.episodes import EpisodeStore
from repdib_lightning.data.inspection_text import short_number

_MOST_FACTORS = 8


def class_names(store: EpisodeStore) -> dict[str, list[str]]:
    """Categorical factor, or ``actions`` -> names of its classes, where the attribute ``classes`` has one for each.

    What another program wrote there is passed over: numbers are shown then.
    """
    try:
        stated = json.loads(str(store.attributes.get("classes", "{}")))
    except ValueError:
        return {}
    counts = {name: spec.classes for name, spec in store.factors.items() if spec.scale == "categorical"}
    if store.actions_spec is not None and store.actions_spec.kind == "discrete":
        counts["actions"] = store.actions_spec.size
    named = stated if isinstance(stated, dict) else {}
    return {
        key: [str(name) for name in named[key]]
        for key, count in counts.items()
        if isinstance(named.get(key), list) and len(named[key]) >= count
    }


def captions(store: EpisodeStore, rows: np.ndarray, *, actions: bool) -> list[list[str]]:
    """Lines below each of some frames, the agent's own factors first; at most eight factors, and how many more.

    Args:
        store: where the rows live.
        rows: (n,) int64.
        actions: whether to begin with the action, if the store has any.

    Returns:
        As many lists as rows, with equally many lines.
    """
    names = class_names(store)
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
