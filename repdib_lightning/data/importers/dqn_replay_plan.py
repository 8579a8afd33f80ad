"""What an import of DQN-replay logs is going to write, and all that can be checked before it writes."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from itertools import groupby
from typing import TYPE_CHECKING, Literal

import numpy as np

from repdib_lightning.data.importers.dqn_replay_files import ReplayLogs, Steps
from repdib_lightning.data.importers.dqn_replay_padding import is_padded, with_padding
from repdib_lightning.data.importers.dqn_replay_report import LeftOut
from repdib_lightning.data.importers.dqn_replay_selection import (
    RULES,
    Ends,
    Piece,
    Rule,
    Selection,
    decision_transformer,
    in_order,
)
from repdib_lightning.errors import UserError, nearest

if TYPE_CHECKING:
    from repdib_lightning.environments.side_image import Side

_COUNTED = 50  # checkpoints that the Decision Transformer draws from; one numbered 50 holds what was left at the end
_LONGEST = 27_003  # Dopamine ends an episode after 27,000 steps; three rows of padding
_LEAST = {"transitions": 1, "per_visit": 1, "read_up_to": 1, "seed": 0}


@dataclass(frozen=True)
class Options:
    """What decides the store, besides the files; ``import_dqn_replay`` says what each of them means.

    Raises:
        UserError: an unknown choice, or a number out of range.
    """

    selection: Rule
    transitions: int
    per_visit: int
    read_up_to: int
    partial: Literal["drop", "keep"]
    padding: Literal["drop", "keep"]
    side: Side
    side_width: int
    side_source: str
    seed: int

    def __post_init__(self) -> None:
        for option, choices in (("selection", RULES), ("partial", ("drop", "keep")), ("padding", ("drop", "keep"))):
            value = getattr(self, option)
            if value not in choices:
                raise UserError(f"{option}={value}: unknown, {nearest(value, choices)}")
        for option, least in _LEAST.items():
            if getattr(self, option) < least:
                raise UserError(f"{option}={getattr(self, option)}: must be at least {least}")
        if self.seed >= 2**32:
            raise UserError(f"seed={self.seed}: must be below {2**32}")


@dataclass(frozen=True)
class Plan:
    """What is going to be written.

    Attributes:
        pieces: in the order of the files.
        left_out: what is not.
        size: height and width of the frames.
        mid_episode: pieces whose beginning their checkpoint does not hold.
    """

    pieces: list[Piece]
    left_out: LeftOut
    size: int
    mid_episode: int


def make_plan(logs: ReplayLogs, checkpoints: list[int] | None, options: Options, meanings: list[str]) -> Plan:
    """Choose episodes by their ends, look for padding, and check all that will be read but the frames.

    Args:
        logs: the files.
        checkpoints: numbers, or None for all that the selection is meant for.
        options: what the user chose.
        meanings: names of the game's actions.

    Raises:
        UserError: as ``import_dqn_replay`` says.
    """
    selection = _select(logs, logs.chosen(_numbers(logs, checkpoints, options)), options)
    taken = sorted(selection.pieces)
    if not taken:
        raise _nothing(logs, options)
    padded = options.padding == "drop" and is_padded(logs, taken)
    pieces: list[Piece] = []
    sizes: dict[int, int] = {}
    for number, group in groupby(taken, key=lambda piece: piece.checkpoint):
        steps, of_checkpoint = logs.steps(number), list(group)
        sizes[number] = steps.size
        for piece in of_checkpoint:
            _check_steps(logs, piece, steps, meanings)
        pieces += with_padding(logs, of_checkpoint, steps) if padded else of_checkpoint
    _check_sizes(logs, sizes)
    kept = [piece for piece in pieces if piece.actions > 0]  # not a piece of one frame without an end
    if not kept:
        raise _nothing(logs, options)
    left_out = LeftOut(
        padding=sum(piece.padding for piece in pieces),
        without_end=len(selection.without_end),
        without_end_rows=sum(piece.logged for piece in selection.without_end),
        given_up=len(selection.given_up),
        given_up_rows=sum(piece.logged for piece in selection.given_up),
        older=selection.older,
    )
    mid_episode = sum(piece.start == 0 and piece.padding == 0 and piece.checkpoint > 0 for piece in kept)
    return Plan(kept, left_out, next(iter(sizes.values())), mid_episode)


def _numbers(logs: ReplayLogs, checkpoints: list[int] | None, options: Options) -> list[int] | None:
    if checkpoints is not None or options.selection != "decision_transformer":
        return checkpoints
    return [number for number in logs.numbers if number < _COUNTED] or None


def _select(logs: ReplayLogs, numbers: list[int], options: Options) -> Selection:
    @cache
    def ends(number: int) -> Ends:
        steps = logs.steps(number)
        return Ends(len(steps), np.flatnonzero(steps.terminals), steps.older)

    keep = options.partial == "keep"
    if options.selection != "decision_transformer":
        wanted = options.transitions if options.selection == "first" else None
        return in_order(ends, numbers, transitions=wanted, keep=keep)
    return decision_transformer(
        ends,
        numbers,
        transitions=options.transitions,
        per_visit=options.per_visit,
        read_up_to=options.read_up_to,
        seed=options.seed,
        keep=keep,
    )


def _nothing(logs: ReplayLogs, options: Options) -> UserError:
    if options.selection == "decision_transformer":
        return UserError(
            f"{logs.folder}: no checkpoint holds the {options.per_visit + 1} episodes of a visit before row "
            f"{options.read_up_to:,}; choose a smaller --per_visit, --selection first or --partial keep"
        )
    return UserError(
        f"{logs.folder}: no episode ends in these checkpoints; --partial keep takes them as truncated ones"
    )


def _check_steps(logs: ReplayLogs, piece: Piece, steps: Steps, meanings: list[str]) -> None:
    number, rows = piece.checkpoint, slice(piece.start, piece.stop)
    if piece.logged > _LONGEST:
        raise UserError(
            f"{logs.path('terminal', number)}: has no end in rows {piece.start:,} to {piece.stop - 2:,}; an episode of "
            f"Dopamine has at most {_LONGEST:,} rows"
        )

    def refuse(array: str, wrong: np.ndarray, values: np.ndarray, must: str) -> None:
        if wrong.any():
            row = int(wrong.argmax())
            raise UserError(f"{logs.path(array, number)}: is {values[row]} at row {piece.start + row:,}, {must}")

    actions, rewards = steps.actions[rows], steps.rewards[rows]
    known = f"must be an action of the game, 0 to {len(meanings) - 1} ({', '.join(meanings)})"
    refuse("action", (actions < 0) | (actions >= len(meanings)), actions, known)
    refuse("reward", ~np.isfinite(rewards), rewards, "must be finite")


def _check_sizes(logs: ReplayLogs, sizes: dict[int, int]) -> None:
    first = next(iter(sizes))
    for number, size in sizes.items():
        if size != sizes[first]:
            raise UserError(
                f"{logs.path('observation', number)}: has frames of {size} x {size} pixels, "
                f"{logs.path('observation', first).name} has {sizes[first]} x {sizes[first]}"
            )
