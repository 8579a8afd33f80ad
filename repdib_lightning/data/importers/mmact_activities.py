"""The 37 classes of MMAct, of 35 names of files: two of them are other activities at the desk, which is scene 3."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Literal

from repdib_lightning.data.importers.mmact_trials import Trial
from repdib_lightning.errors import UserError, nearest

_DESK_SCENE = 3
_DESK_ACTIVITIES = ("talking_on_phone", "using_phone")
_FILE_NAMES = (
    *("carrying", "carrying_heavy", "carrying_light", "checking_time", "closing", "crouching", "drinking", "entering"),
    *("exiting", "fall", "jumping", "kicking", "loitering", "looking_around", "opening", "picking_up", "pocket_in"),
    *("pocket_out", "pointing", "pulling", "pushing", "running", "setting_down", "sitting", "sitting_down", "standing"),
    *("standing_up", "talking", "talking_on_phone", "throwing", "transferring_object", "using_pc", "using_phone"),
    *("walking", "waving_hand"),
)
CLASSES = sorted((*_FILE_NAMES, *(f"{name}_desk" for name in _DESK_ACTIVITIES)))


def without(trials: Sequence[Trial], leave_out: str) -> list[Trial]:
    """The trials but those whose files have one of the names.

    Raises:
        UserError: a name that no file has, or nothing remains.
    """
    names = {word.strip().lower() for word in leave_out.split(",")} - {""}
    known = {trial.activity for trial in trials}
    for name in sorted(names - known):
        raise UserError(f"--leave_out: no file is called '{name}', {nearest(name, known)}")
    if names >= known:
        raise UserError("--leave_out names every activity; nothing remains")
    return [trial for trial in trials if trial.activity not in names]


def classed(trials: Sequence[Trial], activities: Literal["mmact", "found"]) -> tuple[list[Trial], list[str]]:
    """Trials whose activity is the class, and the names of all classes.

    Args:
        trials: activities are names of files.
        activities: ``mmact``: the 37 classes, whether they occur or not; ``found``: the names that occur.

    Raises:
        UserError: naming the file: it is called like none of the 35.
    """
    if activities == "found":
        return list(trials), sorted({trial.activity for trial in trials})
    for trial in trials:
        if trial.activity not in _FILE_NAMES:
            file = next(iter((*trial.videos.values(), *trial.sensors.values())))
            raise UserError(
                f"{file}: unknown activity '{trial.activity}', {nearest(trial.activity, _FILE_NAMES)}; --leave_out "
                f"{trial.activity} goes without it, --activities found takes the names of the files as they are"
            )
    return [replace(trial, activity=_class_of(trial)) for trial in trials], CLASSES


def _class_of(trial: Trial) -> str:
    at_desk = trial.scene == _DESK_SCENE and trial.activity in _DESK_ACTIVITIES
    return f"{trial.activity}_desk" if at_desk else trial.activity
