"""What pictures by domain and class lack as a factorial."""

from __future__ import annotations

from collections.abc import Sequence

from repdib_lightning.data.importers.picture_folders import Picture

_NAMED = 3


def notes_on_combinations(pictures: Sequence[Picture], names: tuple[str, str]) -> list[str]:
    """What whoever measures factors has to know, a line each.

    Args:
        pictures: at least one.
        names: what domain and class are called.

    Returns:
        A line for each of the two that never changes, and one of the combinations that have no picture.
    """
    domains, labels = sorted({picture.domain for picture in pictures}), sorted({picture.label for picture in pictures})
    lines = [
        f"'{name}' is always '{classes[0]}': nothing can be measured of it"
        for name, classes in zip(names, (domains, labels), strict=True)
        if len(classes) == 1
    ]
    there = {(picture.domain, picture.label) for picture in pictures}
    missing = [f"{domain}/{label}" for domain in domains for label in labels if (domain, label) not in there]
    if missing:
        shown = ", ".join(missing[:_NAMED]) + (", ..." if len(missing) > _NAMED else "")
        lines.append(f"{len(missing)} of {len(domains) * len(labels)} combinations have no picture: {shown}")
    return lines
