"""Which bundle a path on the command line means, what to call it, and which of its files a report must not replace."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from repdib_lightning.errors import UserError

FOLDER = "bundle"
"""Where ``export`` puts a run's bundle by default."""


def bundle_of(path: Path) -> Path:
    """The bundle of a run's folder; any other path stays as it is."""
    return path / FOLDER if (path / FOLDER).is_dir() else path


def display_name(path: Path) -> str:
    """The run's name for runs/a and runs/a/bundle, else the name of the bundle's folder."""
    return _tail(_place(path), 1)


def named_bundles(given: Sequence[str]) -> dict[str, Path]:
    """Name the bundles of a comparison.

    Args:
        given: ``PATH`` of a run or a bundle, or ``NAME=PATH`` (a name holds no slash).

    Returns:
        name -> bundle, in the order given. Without a name of its own, a bundle is called by the shortest end of its
        path that no other one has.

    Raises:
        UserError: an empty name or path, a name given twice, or the same bundle twice without names.
    """
    pairs = [_name_and_path(text) for text in given]
    chosen = [name for name, _ in pairs if name is not None]
    for given_name in chosen:
        if chosen.count(given_name) > 1:
            raise UserError(f"compare: two runs are called '{given_name}'")
    unnamed = [_place(path) for name, path in pairs if name is None]
    bundles = {}
    for name, path in pairs:
        called = _distinguished(_place(path), unnamed, chosen) if name is None else name
        bundles[called] = bundle_of(path)
    return bundles


def protected_files(bundle: Path) -> list[Path]:
    """Files of a bundle, and of the run around it, that no report may replace."""
    in_bundle = [bundle / "config.json"]
    return in_bundle + [folder / name for folder in (bundle, bundle.parent) for name in _OF_RUNS]


_OF_RUNS = ("bundle.json", "environment.json", "status.json")


def _name_and_path(text: str) -> tuple[str | None, Path]:
    name, equals, path = text.partition("=")
    if not equals or "/" in name or Path(text).exists():
        return None, Path(text)
    if not name or not path:
        raise UserError(f"compare: expected PATH or NAME=PATH, got '{text}'")
    return name, Path(path)


def _place(path: Path) -> Path:
    """The folder that gives a bundle its name."""
    bundle = bundle_of(path).resolve()
    return bundle.parent if bundle.name == FOLDER else bundle


def _tail(place: Path, parts: int) -> str:
    return str(Path(*place.parts[-parts:]))


def _distinguished(place: Path, others: Sequence[Path], taken: Sequence[str]) -> str:
    if others.count(place) > 1:
        raise UserError(f"compare: {place} is given twice; name them: NAME=PATH")
    rivals = [other for other in others if other != place]
    for parts in range(1, len(place.parts) + 1):
        name = _tail(place, parts)
        if name not in taken and all(name != _tail(other, parts) for other in rivals):
            return name
    raise AssertionError("whole paths differ")
