"""Which pictures of a folder by domain and class are held out: a balanced choice, or official lists."""

from __future__ import annotations

from collections import Counter
from pathlib import Path

import pytest
from picture_trees import CLASSES, DOMAINS, convert, refuse, write_tree
from PIL import Image

from repdib_lightning.data.importers.picture_folders import Picture
from repdib_lightning.data.importers.picture_splits import choose_held_out


@pytest.fixture
def source(tmp_path) -> Path:
    return write_tree(tmp_path / "PACS", each=3)


def pictures_of(counts: dict[tuple[str, str], int]) -> list[Picture]:
    return [Picture(d, c, Path(f"{i}.png")) for (d, c), count in counts.items() for i in range(count)]


def held_by(pictures: list[Picture], chosen: set[str], what: str) -> Counter[str]:
    held = Counter({getattr(picture, what): 0 for picture in pictures})
    held.update(getattr(picture, what) for picture in pictures if picture.key in chosen)
    return held


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("shape", [(7, 30), (3, 4), (2, 11)])
def test_a_factorial_holds_out_combinations_evenly(shape, seed):
    pictures = pictures_of({(f"d{d}", f"c{c}"): 1 for d in range(shape[0]) for c in range(shape[1])})
    chosen = choose_held_out(pictures, 0.2, seed)
    assert len(chosen) == round(0.2 * len(pictures))
    by_domain, by_class = (held_by(pictures, chosen, what) for what in ("domain", "label"))
    assert max(by_domain.values()) - min(by_domain.values()) <= 1
    assert max(by_class.values()) - min(by_class.values()) <= 1
    assert max(by_class.values()) < shape[0]


def test_unequal_domains_give_equal_counts_and_classes_in_proportion():
    sizes = {"art": 60, "sketch": 160}
    counts = {(d, c): size * share for d, size in sizes.items() for c, share in (("dog", 3), ("horse", 1))}
    pictures = pictures_of(counts)
    chosen = choose_held_out(pictures, 0.2, seed=1)
    assert held_by(pictures, chosen, "domain") == {"art": 88, "sketch": 88}
    assert held_by(pictures, chosen, "label") == {"dog": 132, "horse": 44}


def test_no_domain_and_no_class_loses_its_last_training_picture():
    counts = {("a", "x"): 2, ("a", "y"): 1, ("b", "x"): 1, ("b", "z"): 30, ("c", "z"): 1}
    pictures = pictures_of(counts)
    for seed in range(8):
        chosen = choose_held_out(pictures, 0.8, seed)
        assert len(chosen) == 28
        trained = [picture for picture in pictures if picture.key not in chosen]
        assert {p.domain for p in trained} == {"a", "b", "c"} and {p.label for p in trained} == {"x", "y", "z"}


def test_where_every_domain_has_one_picture_some_are_still_held_out():
    pictures = pictures_of({(f"d{d}", "elephant"): 1 for d in range(7)})
    assert len(choose_held_out(pictures, 0.2, 0)) == 1
    assert choose_held_out(pictures[:1], 0.5, 0) == set()


def test_the_seed_decides_what_is_held_out(source):
    held = [convert(source, seed=seed).evaluation for seed in (0, 0, 1)]
    assert held[0].sum() == round(0.2 * 36)
    assert (held[0] == held[1]).all() and (held[0] != held[2]).any()
    assert not convert(source, held_out=0.0).evaluation.any()


def write_lists(folder: Path, source: Path, *, held: str = "pic_002", first: int = 1) -> Path:
    folder.mkdir(exist_ok=True)
    for domain in DOMAINS:
        lists: dict[str, list[str]] = {"train": [], "crossval": []}
        for number, label in enumerate(CLASSES, start=first):
            for file in sorted((source / domain / label).iterdir()):
                part = "crossval" if file.stem == held else "train"
                lists[part].append(f"{domain}/{label}/{file.name} {number}\n")
        for part, lines in lists.items():
            (folder / f"{domain}_{part}_kfold.txt").write_text("".join(lines))
    return folder


def test_official_lists_decide_what_is_held_out(source, capsys):
    splits = write_lists(source.parent / "splits", source)
    store = convert(source, splits=splits)
    assert store.evaluation.tolist() == [False, False, True] * 12
    few = convert(source, splits=splits, domains="cartoon", classes="elephant,horse")
    assert few.evaluation.tolist() == [False, False, True] * 2
    capsys.readouterr()
    Image.new("RGB", (9, 9)).save(source / "art" / "dog" / "new.png")
    assert convert(source, splits=splits).rows == 36
    assert "in no list of the split, not imported: 1 (art/dog/new.png)" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("line", "word"),
    [
        ("cartoon/elephant/pic_000.jpg", "expected 'cartoon/CLASS/PICTURE NUMBER'"),
        ("cartoon/elephant/pic_000.png two", "expected 'cartoon/CLASS/PICTURE NUMBER'"),
        ("elephant/pic_000.png 2", "expected 'cartoon/CLASS/PICTURE NUMBER'"),
        ("photo/elephant/pic_000.png 2", "expected 'cartoon/CLASS/PICTURE NUMBER'"),
        ("cartoon/elephant/pic_000.png 1", "the number 1; in the order of the alphabet"),
        ("cartoon/elephant/pic_009.png 2", "no picture 'cartoon/elephant/pic_009.png'"),
        ("cartoon/dog/pic_000.png 1", "'cartoon/dog/pic_000.png' is listed for the second time"),
    ],
)
def test_a_wrong_line_of_a_list_is_named(source, line, word):
    splits = write_lists(source.parent / "splits", source)
    file = splits / "cartoon_train_kfold.txt"
    lines = file.read_text().splitlines()
    file.write_text("\n".join([*lines[:4], "", line, *lines[4:]]))
    refuse(source, f"{file}: line 6", word, splits=splits)


def test_lists_that_count_from_zero_or_are_missing_are_refused(source):
    splits = write_lists(source.parent / "splits", source, first=0)
    refuse(source, "art_train_kfold.txt: line 1", "'dog' the number 0", "it is 1", splits=splits)
    refuse(source, "splits: ", "no such folder", splits=source / "nowhere")
    (splits / "photo_crossval_kfold.txt").unlink()
    refuse(source, "photo_crossval_kfold.txt: no such list", "did you mean", splits=splits)


def test_a_deleted_picture_may_be_left_out_of_a_list(source):
    splits = write_lists(source.parent / "splits", source)
    (source / "photo" / "dog" / "pic_001.png").unlink()
    message = refuse(source, "photo_train_kfold.txt: line 2", splits=splits)
    assert "--leave_out photo/dog/pic_001.png" in message
    assert convert(source, splits=splits, leave_out="photo/dog/pic_001.png").rows == 35
