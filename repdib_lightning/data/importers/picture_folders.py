"""Pictures in folders of folders: ``SOURCE/<domain>/<class>/<picture>``."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

from repdib_lightning.errors import UserError, nearest

_ENDINGS = (".jpg", ".jpeg", ".png")
LAYOUT = "SOURCE/<domain>/<class>/*.jpg, *.jpeg or *.png"
FLAT_LAYOUT = "SOURCE/<domain>/<class>.png"


@dataclass(frozen=True)
class Picture:
    """One file, and the two folders that it lies in."""

    domain: str
    label: str
    file: Path

    @property
    def key(self) -> str:
        """``domain/class/name``, as lists of splits write it."""
        return f"{self.domain}/{self.label}/{self.file.name}"


def find_drawings(source: Path) -> list[Picture]:
    """Pictures that lie one level down, ``SOURCE/<domain>/<class>.png``: one of each class in each domain.

    Raises:
        UserError: no such folder, or one without that level.
    """
    if not source.is_dir():
        raise UserError(f"{source}: {'is a file' if source.exists() else 'no such folder'}; expected {FLAT_LAYOUT}")
    pictures = [
        Picture(domain, file.stem, file) for domain in _subfolders(source) for file in _pictures_in(source / domain)
    ]
    if not pictures:
        raise UserError(f"{source}: holds no pictures; expected {FLAT_LAYOUT}")
    return pictures


def find_pictures(source: Path, domains: str, classes: str) -> list[Picture]:
    """Pictures of the wanted folders, sorted by domain, class and name.

    Names that begin with a dot or an underscore are passed over, as is whatever is neither a folder nor a picture.

    Args:
        source: holds a folder for each domain.
        domains: comma-separated names of folders, or ``all``.
        classes: the same one level below.

    Raises:
        UserError: no such folder or an empty one, one without those two levels, a name that is not there.
    """
    if not source.is_dir():
        raise UserError(f"{source}: {'is a file' if source.exists() else 'no such folder'}; expected {LAYOUT}")
    there = _subfolders(source)
    if not there:
        reason = "its pictures lie directly in it" if _pictures_in(source) else "an empty folder"
        raise UserError(f"{source}: {reason}; expected {LAYOUT}")
    chosen = _chosen("domains", domains, there, source)
    tree = {domain: {label: _pictures_in(source / domain / label) for label in there[domain]} for domain in chosen}
    known = {label for cells in tree.values() for label, files in cells.items() if files}
    if not known:
        raise UserError(_no_second_level(source, chosen))
    wanted = _chosen("classes", classes, known, source)
    pictures = []
    for domain, cells in tree.items():
        inside = [Picture(domain, label, file) for label in wanted for file in cells.get(label, [])]
        _check_domain(source / domain, inside)
        pictures += inside
    return pictures


def _visible(folder: Path) -> list[Path]:
    try:
        return sorted(entry for entry in folder.iterdir() if entry.name[0] not in "._")
    except OSError as error:
        raise UserError(f"{folder}: cannot be read ({error.strerror or error})") from error


def _subfolders(source: Path) -> dict[str, list[str]]:
    """Folder -> names of the folders in it."""
    return {
        domain.name: [label.name for label in _visible(domain) if label.is_dir()]
        for domain in _visible(source)
        if domain.is_dir()
    }


def _pictures_in(folder: Path) -> list[Path]:
    return [file for file in _visible(folder) if file.suffix.lower() in _ENDINGS and file.is_file()]


def _chosen(option: str, wanted: str, known: Iterable[str], source: Path) -> list[str]:
    words = {word.strip() for word in wanted.split(",")} - {""}
    if words == {"all"} and "all" not in known:
        return sorted(known)
    if not words:
        raise UserError(f"--{option} is empty; name folders of {source}, or 'all'")
    for word in sorted(words - set(known)):
        raise UserError(f"--{option}: {source} has no pictures of '{word}', {nearest(word, [*known, 'all'])}")
    return sorted(words)


def _check_domain(folder: Path, inside: list[Picture]) -> None:
    """Refuse what would be lost without a word: pictures beside the classes, a domain that gives no picture."""
    loose = _pictures_in(folder)
    if loose:
        raise UserError(f"{loose[0]}: lies in no class folder; expected {LAYOUT}")
    if not inside:
        raise UserError(f"{folder}: holds no picture of the classes that are read; name the others with --domains")


def _no_second_level(source: Path, domains: list[str]) -> str:
    loose = [file for domain in domains for file in _pictures_in(source / domain)]
    if loose:
        hint = "or make a store of them with 'collect emoji_styles FILE --source FOLDER'"
        return f"{source}: its pictures lie one level down ({loose[0]}), not two; expected {LAYOUT}, {hint}"
    for file in source.glob("*/*/*/*"):
        if file.suffix.lower() in _ENDINGS:
            return f"{source}: its pictures lie too deep; expected {LAYOUT}; did you mean {file.parents[2]}?"
    return f"{source}: holds no pictures; expected {LAYOUT}"
