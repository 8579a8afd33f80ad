"""Tells at the end of an import what the store holds, what is missing in it, and what was skipped."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from pathlib import Path

from repdib_lightning.data.files import whole_file
from repdib_lightning.data.importers.mmact_clips import Clip, Form
from repdib_lightning.data.importers.mmact_notes import Note
from repdib_lightning.data.importers.mmact_splits import HELD_OUT, Split
from repdib_lightning.word_lists import in_ranges

_MOST_LINES = 20
_COUNTED = {"skipped": "files skipped", "broken": "videos broken", "short": "videos short", "left out": "left out"}


def notes_file(output: Path) -> Path:
    """Where all notes of an import stand, one a line."""
    return output.with_name(f"{output.name}.skipped.txt")


def write_notes(output: Path, notes: Sequence[Note]) -> None:
    """Write the notes beside the store; without any, remove those of an earlier import.

    Raises:
        UserError: the file cannot be written.
    """
    if not notes:
        notes_file(output).unlink(missing_ok=True)
        return
    with whole_file(notes_file(output)) as aside:
        aside.write_text("".join(f"{note}\n" for note in notes), encoding="utf-8")


def summary(
    output: Path, clips: Sequence[Clip], evaluation: Sequence[bool], split: Split, form: Form, notes: Sequence[Note]
) -> list[str]:
    """Lines for the user: one on the store, one on each of the first notes, one on where the others are."""
    test = sum(evaluation)
    subjects = len({clip.trial.subject for clip in clips})
    told = f"{len(clips):,} clips of {subjects} subjects"
    if split != "none":
        factor, values = HELD_OUT[split]
        told += f"; {len(clips) - test:,} to train on, {test:,} to test on ({factor} {in_ranges(values)})"
    missing = ", ".join(f"{name} {count:,}" for name, count in _missing(clips, form, notes).items() if count)
    told += f"; without {missing}" if missing else "; nothing is missing"
    kinds = Counter(note.kind for note in notes)
    told += "".join(f"; {words} {kinds[kind]:,}" for kind, words in _COUNTED.items() if kinds[kind])  # type: ignore[index]
    lines = [f"{output}: {told}", *map(str, notes[:_MOST_LINES])]
    if split == "cross_view" and form.sensors:
        lines.append(
            "cross_view: clips to test on share their sensors with clips to train on; --sensors none avoids it"
        )
    if notes:
        more = f"... and {len(notes) - _MOST_LINES:,} more; " if len(notes) > _MOST_LINES else ""
        lines.append(f"{more}all of these lines are in {notes_file(output)}")
    return lines


def _missing(clips: Sequence[Clip], form: Form, notes: Sequence[Note]) -> dict[str, int]:
    """View or stream of a sensor -> clips that lack it."""
    skipped = {note.what for note in notes if note.kind == "skipped"}
    counts = {}
    for view in form.views:
        counts[view] = sum(_lacks(clip.videos[view], skipped) for clip in clips)
    for sensor, folders in form.sensors.items():
        for folder, place in folders.items():
            name = sensor if len(folders) == 1 else f"{sensor} of the {place}"
            counts[name] = sum(_lacks(clip.trial.sensors.get(folder), skipped) for clip in clips)
    return counts


def _lacks(file: Path | None, skipped: set[str]) -> bool:
    return file is None or str(file) in skipped
