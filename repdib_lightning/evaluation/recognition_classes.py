"""Which of a classifier's classes each class of a store is."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import zip_longest

import numpy as np

from repdib_lightning.data.episodes import EpisodeStore
from repdib_lightning.errors import UserError, nearest


def labels_of(store: EpisodeStore, rows: np.ndarray, target: str, classes: Sequence[str], bundle: str) -> np.ndarray:
    """The true class of (n,) rows as a classifier numbers its classes, (n,) int64.

    Args:
        target: the factor that is recognised. classes: the classifier's, in its order, whatever the store's order is.
        bundle: what holds the classifier, for the error.

    Raises:
        UserError: the store has no such factor, one of numbers, or one whose classes are called otherwise.
    """
    if target not in store.factors:
        known = nearest(target, store.factors) or "it has none"
        raise UserError(f"{store.path}: has no factor '{target}', which {bundle} recognises, {known}")
    if store.factors[target].scale != "categorical":
        raise UserError(f"{store.path}: 'factors/{target}' is no class, {bundle} recognises classes")
    held = store.value_names(target)
    if sorted(held) != sorted(classes):
        raise UserError(f"{store.path}: {_difference(held, classes, target, bundle)}")
    places = np.array([list(classes).index(name) for name in held])
    return places[store.gather(f"factors/{target}", rows).reshape(len(rows))]


def _difference(held: Sequence[str], classes: Sequence[str], target: str, bundle: str) -> str:
    """The first class, in the order of the store or of the bundle, that the other one lacks."""
    for ours, theirs in zip_longest(held, classes):
        if ours is not None and ours not in classes:
            return f"'{target}' has the class '{ours}', which {bundle} does not know, {nearest(ours, classes)}"
        if theirs is not None and theirs not in held:
            return f"'{target}' has no class '{theirs}', which {bundle} recognises, {nearest(theirs, held)}"
    return f"'{target}' has several classes of one name"
