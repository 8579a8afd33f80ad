"""What ``inspect`` tells of clips: what is missing of them, how long they are, how many there are of each class."""

from __future__ import annotations

import textwrap

import numpy as np

from repdib_lightning.data.clips import holds_clips, is_clip, lacks_channels, observed_steps
from repdib_lightning.data.episodes import EpisodeStore
from repdib_lightning.data.inspection_text import short_number, spread

_WIDTH, _MOST_CLASSES = 116, 60


def describe_clips(store: EpisodeStore) -> list[str]:
    """Lines of the report; none for stores of other things."""
    if not holds_clips(store):
        return []
    streams = [name for name in store.observations if is_clip(store, name)]
    return ["", _counted(store), *(f"  {name}: {_stream(store, name)}" for name in streams), *_class_counts(store)]


def _counted(store: EpisodeStore) -> str:
    recordings = len(np.unique(store.recordings))
    return f"clips: {store.rows:,}" + (f" of {recordings:,} recordings" if recordings < len(store.lengths) else "")


def _stream(store: EpisodeStore, name: str) -> str:
    steps = observed_steps(store, name).sum(axis=1)
    there = steps[steps > 0]
    missing = len(steps) - len(there)
    if not len(there):
        return f"{missing:,} of {len(steps):,} clips missing"
    parts = [f"{missing:,} of {len(steps):,} clips missing" if missing else "no clip missing"]
    parts.append(f"observed steps: {spread(there)}")
    lacking = int(lacks_channels(store, name).sum()) if store.observations[name].is_sequence else 0
    if lacking:
        parts.append(f"some channels missing in {lacking:,}")
    return "; ".join(parts)


def _class_counts(store: EpisodeStore) -> list[str]:
    """Each categorical factor with the number of clips of every class."""
    names = store.class_names
    held_out = np.isin(store.row_episodes, store.episodes("evaluation"))
    lines = ["", "clips of each class (of them for evaluation):"]
    for factor, spec in sorted(store.factors.items()):
        if spec.scale != "categorical":
            continue
        values = np.asarray(store.array(f"factors/{factor}")[:])
        counts = np.bincount(values, minlength=spec.classes)
        apart = np.bincount(values[held_out], minlength=spec.classes)
        named = names.get(factor) or [str(number) for number in range(spec.classes)]
        shown = [f"{named[i]}: {counts[i]:,} ({apart[i]:,})" for i in range(min(spec.classes, _MOST_CLASSES))]
        rest = [f"and {short_number(spec.classes - _MOST_CLASSES)} more"] if spec.classes > _MOST_CLASSES else []
        lines += _wrapped(f"  {factor}  ", [*shown, *rest])
    return lines if len(lines) > 2 else []


def _wrapped(head: str, words: list[str]) -> list[str]:
    """Lines of words between commas; a name and its count stay together."""
    kept = ", ".join(word.replace(" ", "\u00a0") for word in words)
    lines = textwrap.wrap(
        kept, _WIDTH, initial_indent=head, subsequent_indent="    ", break_long_words=False, break_on_hyphens=False
    )
    return [line.replace("\u00a0", " ") for line in lines]
