"""Folders of flat pictures by domain and class, and stores of them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from PIL import Image

from repdib_lightning.data.episodes import EpisodeStore
from repdib_lightning.data.importers.pacs import import_pacs
from repdib_lightning.errors import UserError

DOMAINS, CLASSES = ("art", "cartoon", "photo"), ("dog", "elephant", "giraffe", "horse")


def write_tree(root: Path, each: int = 1, domains=DOMAINS, classes=CLASSES, ending: str = "png") -> Path:
    """``each`` flat pictures a combination: red tells the domain, green the class, blue the number."""
    for d, domain in enumerate(domains):
        for c, label in enumerate(classes):
            folder = root / domain / label
            folder.mkdir(parents=True)
            for number in range(each):
                colour = (40 * d + 20, 40 * c + 20, 10 * number)
                Image.new("RGB", (9, 9), colour).save(folder / f"pic_{number:03d}.{ending}")
    return root


def convert(source: Path, **options: Any) -> EpisodeStore:
    output = source.parent / "out" / "store.h5"
    return EpisodeStore(
        import_pacs(
            source,
            output,
            **{"size": 8, "domains": "all", "classes": "all", "progress": False, "overwrite": True, **options},
        )
    )


def refuse(source: Path, *words: str, **options: Any) -> str:
    with pytest.raises(UserError) as caught:
        convert(source, **options)
    message = str(caught.value)
    assert "\n" not in message
    for word in words:
        assert word in message, message
    assert not list((source.parent / "out").glob("*"))
    assert not list((source.parent / "out").glob(".*"))
    return message
