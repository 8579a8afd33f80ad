"""Opens a store with the episodes held out that a bundle was not trained on."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from repdib_lightning.data.episodes import EpisodeStore
from repdib_lightning.errors import UserError

HeldOut = Mapping[str, list[str]]
"""Factor -> names of the values that no training episode has."""


def open_held_out(data: Path, descriptions: Mapping[str, Mapping[str, Any]]) -> EpisodeStore:
    """Open a store whose evaluation episodes are those that bundles held out; its own where they name no factor.

    Args:
        data: the file.
        descriptions: what to call each bundle -> its ``config.json``.

    Raises:
        UserError: no store, one without what was held out, or bundles that held out different episodes.
    """
    held = {name: _held_out(description) for name, description in descriptions.items()}
    first, wanted = next(iter(held.items()))
    for name, other in held.items():
        if other != wanted:
            raise UserError(
                f"{first} was trained with {_shown(wanted)} held out, {name} with {_shown(other)}: one of them would "
                "be scored on what it was trained on"
            )
    store = EpisodeStore(data)
    if not wanted:
        return store
    try:
        return EpisodeStore(data, held_out=wanted)
    except UserError as error:
        raise UserError(f"{error}; {first} was trained with {_shown(wanted)} held out") from error


def _held_out(description: Mapping[str, Any]) -> HeldOut:
    facts = description.get("data")
    return (facts.get("held_out") if isinstance(facts, Mapping) else None) or {}


def _shown(held_out: HeldOut) -> str:
    """``subject 17, 18 and session 5``."""
    listed = [f"{factor} {', '.join(map(str, values))}" for factor, values in held_out.items()]
    return " and ".join(listed) or "the data's own evaluation episodes"
