"""The four splits of MMAct that public code agrees on: which clips are never trained on."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

from repdib_lightning.data.importers.mmact_clips import Clip
from repdib_lightning.errors import UserError
from repdib_lightning.word_lists import in_ranges

Split = Literal["cross_subject", "cross_session", "cross_scene", "cross_view", "none"]
HELD_OUT: dict[str, tuple[str, frozenset[int]]] = {
    "cross_subject": ("subject", frozenset({17, 18, 19, 20})),
    "cross_session": ("session", frozenset({5})),
    "cross_scene": ("scene", frozenset({2})),
    "cross_view": ("camera", frozenset({4})),
}
"""Split -> factor, and its values that are tested on."""


def held_out(clips: Sequence[Clip], split: Split) -> list[bool]:
    """Whether each clip is tested on; nothing is with ``none``.

    Raises:
        UserError: nothing to test on, or nothing to train on.
    """
    if split == "none":
        return [False] * len(clips)
    factor, values = HELD_OUT[split]
    if factor == "camera" and any(clip.camera is None for clip in clips):
        raise UserError("--split cross_view: tests on a camera of its own, pass --cameras_apart (a clip a camera)")
    found = {clip.factors[factor] for clip in clips}
    if not found & values or found <= values:
        missing = "test" if not found & values else "training"
        numbers = f" ({in_ranges(values)})" if missing == "test" else f" (any but {in_ranges(values)})"
        raise UserError(
            f"--split {split}: no {missing} {factor}{numbers} among the {factor}s found: {in_ranges(found)}; "
            f"choices: {', '.join(_possible(clips))}"
        )
    return [clip.factors[factor] in values for clip in clips]


def _possible(clips: Sequence[Clip]) -> list[str]:
    names = []
    for split, (factor, values) in HELD_OUT.items():
        found = {clip.factors.get(factor, -1) for clip in clips}
        if found & values and not found <= values:
            names.append(split)
    return [*names, "none"]
