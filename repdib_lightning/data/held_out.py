"""Splits by values of factors: cross-subject, cross-session, cross-scene, cross-view."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from repdib_lightning.errors import UserError, nearest

if TYPE_CHECKING:
    from repdib_lightning.data.episodes import EpisodeStore

HeldOut = Mapping[str, Sequence[str | int]]
"""Categorical factor -> names of the values that are held out."""


def as_names(held_out: HeldOut | None) -> dict[str, list[str]] | None:
    """Plain lists of text, of what a configuration may write as numbers; None where nothing is held out.

    Raises:
        UserError: the values of a factor are no list, or none are named.
    """
    named: dict[str, list[str]] = {}
    for factor, values in (held_out or {}).items():
        if isinstance(values, str) or not isinstance(values, Sequence) or not values:
            raise UserError(f"held_out: {factor} is {values!r}; name the values to hold out, such as {factor}: [1, 2]")
        named[factor] = [str(value) for value in values]
    return named or None


def held_out_episodes(store: EpisodeStore, held_out: dict[str, list[str]]) -> np.ndarray:
    """(E,) bool: the episodes that have any of the values.

    Raises:
        UserError: an unknown factor or value, a factor that is not categorical or changes within an episode, no
            episode or every episode held out.
    """
    chosen = np.zeros(len(store.starts), bool)
    for factor, names in held_out.items():
        known = _names(store, factor)
        for name in names:
            if name not in known:
                raise UserError(f"{store.path}: held_out: {factor} has no '{name}', {nearest(name, known)}")
        chosen |= np.isin(_per_episode(store, factor), [known.index(name) for name in names])
    told = " or ".join(f"{factor} {', '.join(names)}" for factor, names in held_out.items())
    if not chosen.any():
        raise UserError(f"{store.path}: held_out: none of {len(chosen)} episodes has {told}; {_found(store, held_out)}")
    if chosen.all():
        raise UserError(
            f"{store.path}: held_out: each of {len(chosen)} episodes has {told}, none is left for training; "
            f"{_found(store, held_out)}"
        )
    return chosen


def _names(store: EpisodeStore, factor: str) -> list[str]:
    categorical = [name for name, spec in store.factors.items() if spec.scale == "categorical"]
    if factor not in store.factors:
        hint = nearest(factor, categorical) or "the file has no categorical factor"
        raise UserError(f"{store.path}: held_out: has no factor '{factor}', {hint}")
    if factor not in categorical:
        hint = nearest("", categorical) or "the file has no categorical factor"
        raise UserError(f"{store.path}: held_out: factor '{factor}' is continuous, {hint}")
    return store.value_names(factor)


def _per_episode(store: EpisodeStore, factor: str) -> np.ndarray:
    """(E,) int64: the factor's value in each episode."""
    values = np.asarray(store.array(f"factors/{factor}")[:]).reshape(-1)
    found = values[store.starts]
    changing = np.flatnonzero(values != np.repeat(found, store.lengths))
    if len(changing):
        raise UserError(
            f"{store.path}: held_out: factor '{factor}' changes within episode {store.row_episodes[changing[0]]}; "
            "episodes are held out whole, choose a factor that stays as it is throughout each"
        )
    return found


def _found(store: EpisodeStore, held_out: dict[str, list[str]]) -> str:
    """The values that do occur, factor by factor."""
    told = []
    for factor in held_out:
        names = store.value_names(factor)
        present = [names[value] for value in np.unique(_per_episode(store, factor))]
        told.append(f"{factor} is {', '.join(present[:12])}{', ...' if len(present) > 12 else ''}")
    return "; ".join(told)
