"""Which column of a CSV means what: as the user says, else recognised by its name and values."""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from pathlib import Path

from repdib_lightning.data.importers.file_order import natural_key
from repdib_lightning.data.importers.image_table import Table
from repdib_lightning.errors import UserError

IMAGE_ENDINGS = (".png", ".jpg", ".jpeg", ".bmp", ".webp", ".tif", ".tiff", ".ppm", ".gif")
_ACTIONS = ("action", "command", "act", "move")
_EPISODES = ("episode", "episode_id", "episode_index", "ep", "trajectory", "trajectory_id", "traj", "sequence")
_TIMES = ("time", "time_index", "timestep", "time_step", "step", "t", "index", "frame", "frame_index", "timestamp")
_STATES = ("cell", "true_cell", "grid_cell", "cell_id", "state", "true_state", "position", "true_position")
_FILLERS = {"image", "images", "img", "file", "filename", "path", "name", "before", "camera", "view", "frame"}


@dataclass
class ColumnChoice:
    """The columns to read.

    Attributes:
        images: observation name -> column of file names.
        actions: the action's column or columns; empty for data without actions.
        factors: column -> (kind, scale or None to decide by the values).
        episode: column that tells episodes apart, or None.
        time: column that must not decrease within an episode, or None.
    """

    images: dict[str, str]
    actions: list[str]
    factors: dict[str, tuple[str, str | None]] = field(default_factory=dict)
    episode: str | None = None
    time: str | None = None

    def unused(self, table: Table) -> list[str]:
        """Columns that nothing reads."""
        read = {*self.images.values(), *self.actions, *self.factors, self.episode, self.time}
        return [name for name in table.columns if name not in read]


def choose_columns(
    table: Table,
    *,
    image_columns: str | None,
    action_column: str | None,
    factor_columns: str | None,
    episode_column: str | None,
    time_column: str | None,
) -> ColumnChoice:
    """Settle every column; options are comma-separated names, ``none`` for no such column, None to recognise it.

    Raises:
        UserError: an option names a column that does not exist, or none is recognised; lists the columns.
    """
    choice = ColumnChoice(_images(table, image_columns), _actions(table, action_column))
    choice.episode = _single(table, episode_column, "episode_column", _EPISODES)
    choice.time = _single(table, time_column, "time_column", _TIMES)
    taken = {*choice.images.values(), *choice.actions, choice.episode}
    choice.factors = _factors(table, factor_columns, taken)
    return choice


def _plain(name: str) -> str:
    return re.sub(r"[^a-z0-9]+", "_", name.lower()).strip("_")


def _listed(table: Table) -> str:
    return ", ".join(table.columns)


def _items(option: str) -> list[str]:
    return [item.strip() for item in option.split(",") if item.strip()]


def _images(table: Table, option: str | None) -> dict[str, str]:
    if option is not None:
        pairs = [item.rpartition("=")[::2] for item in _items(option)]
        chosen = {column: name for name, column in pairs}
        for column in chosen:
            table.column(column, "image_columns")
    else:
        chosen = dict.fromkeys((name for name in table.columns if _holds_file_names(table.columns[name])), "")
        before = [name for name in chosen if "before" in _plain(name).split("_")]
        if before:
            chosen = {name: "" for name in chosen if not {"after", "next"} & set(_plain(name).split("_"))}
    if not chosen:
        raise UserError(
            f"{table.path}: no column holds image file names; pass --image_columns (columns: {_listed(table)})"
        )
    named = {given or _observation_name(column, len(chosen)): column for column, given in chosen.items()}
    if len(named) < len(chosen):
        raise UserError(f"{table.path}: image_columns: give each column its own name, as in front=column,top=column")
    return named


def _holds_file_names(texts: list[str]) -> bool:
    return Path(texts[0]).suffix.lower() in IMAGE_ENDINGS


def _observation_name(column: str, columns: int) -> str:
    """``front_image`` -> ``front``; a single camera whose column says nothing more is ``pixels``."""
    words = [word for word in _plain(column).split("_") if word not in _FILLERS]
    return "_".join(words) or ("pixels" if columns == 1 else _plain(column))


def _actions(table: Table, option: str | None) -> list[str]:
    if option is not None:
        names = [] if option == "none" else _items(option)
        for name in names:
            table.column(name, "action_column")
        return names
    single = [name for name in table.columns if _plain(name) in _ACTIONS]
    numbered = [name for name in table.columns if re.fullmatch(r"(action|act|a)_?\d+", _plain(name))]
    if len(single) + bool(numbered) > 1:
        listed = ", ".join(single + numbered)
        raise UserError(f"{table.path}: several columns may be the action ({listed}); pass --action_column")
    if not single and not numbered:
        raise UserError(
            f"{table.path}: no column is called action; pass --action_column, or --action_column none for images "
            f"without actions (columns: {_listed(table)})"
        )
    return single or sorted(numbered, key=lambda name: natural_key(name))


def _single(table: Table, option: str | None, option_name: str, usual: tuple[str, ...]) -> str | None:
    if option == "none":
        return None
    if option is not None:
        table.column(option, option_name)
        return option
    plain = {_plain(name): name for name in table.columns}
    return next((plain[name] for name in usual if name in plain), None)


def _factors(table: Table, option: str | None, taken: set[str | None]) -> dict[str, tuple[str, str | None]]:
    factors: dict[str, tuple[str, str | None]] = {}
    if option is None:
        free = {name: _plain(name) for name in table.columns if name not in taken}
        for kind, usual in (("endogenous", _STATES), ("exogenous", _TIMES)):
            factors |= {name: (kind, None) for name, plain in free.items() if plain in usual}
        return factors
    for item in [] if option == "none" else _items(option):
        name, kind, scale = [*item.split(":"), "", ""][:3]
        table.column(name, "factor_columns")
        if kind not in ("endogenous", "exogenous") or scale not in ("", "categorical", "continuous"):
            raise UserError(
                f"factor_columns: '{item}' must be COLUMN:endogenous or COLUMN:exogenous, then perhaps "
                ":categorical or :continuous"
            )
        factors[name] = (kind, scale or None)
    return factors
