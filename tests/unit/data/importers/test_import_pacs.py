"""Folders of pictures by domain and class: what is read, told and refused."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from picture_trees import CLASSES, DOMAINS, convert, refuse, write_tree
from PIL import Image

from repdib_lightning.__main__ import main
from repdib_lightning.data.episodes import EpisodeStore
from repdib_lightning.data.fingerprint import recompute_fingerprint
from repdib_lightning.data.importers.pacs import import_pacs
from repdib_lightning.data.importers.picture_folders import find_pictures
from repdib_lightning.errors import UserError


@pytest.fixture
def source(tmp_path) -> Path:
    return write_tree(tmp_path / "PACS", each=3)


def names(store: EpisodeStore) -> list[tuple[str, ...]]:
    """(domain, class) of each row, by the stored numbers and names."""
    classes = json.loads(store.attributes["classes"])
    columns = [[classes[name][value] for value in store.array(f"factors/{name}")] for name in ("domain", "class")]
    return list(zip(*columns, strict=True))


def test_each_picture_is_an_episode_with_its_two_factors(source):
    store = convert(source)
    assert store.lengths.tolist() == [1] * 36 and store.actions_spec is None
    kinds = {name: (f.kind, f.scale, f.classes) for name, f in store.factors.items()}
    assert kinds == {"class": ("endogenous", "categorical", 4), "domain": ("endogenous", "categorical", 3)}
    assert names(store) == [(domain, label) for domain in DOMAINS for label in CLASSES for _ in range(3)]
    for row, (domain, label) in enumerate(names(store)):
        colour = [40 * DOMAINS.index(domain) + 20, 40 * CLASSES.index(label) + 20, 10 * (row % 3)]
        assert (store.array("observations/pixels")[row] == np.array(colour)[:, None, None]).all()
    assert recompute_fingerprint(store) == store.fingerprint


def test_the_verb_imports_and_inspects(source, capsys):
    out = source.parent / "s.h5"
    words = ["pacs", str(source), str(out), "--size", "12", "--factors", "style,species", "--domains", "cartoon,art"]
    words += ["--classes", "all"]
    assert main(["import", *words, "--environment", "emoji", "--licence", "CC BY 4.0"]) == 0
    store = EpisodeStore(out)
    assert set(store.factors) == {"style", "species"}
    assert json.loads(store.attributes["classes"])["style"] == ["art", "cartoon"]
    assert (store.attributes["environment"], store.attributes["licence"]) == ("emoji", "CC BY 4.0")
    assert capsys.readouterr().err == ""
    assert main(["inspect", str(out)]) == 0


def test_chosen_folders_are_numbered_among_themselves(source):
    store = convert(source, domains="photo, cartoon", classes="horse,elephant")
    assert set(names(store)) == {(d, c) for d in ("cartoon", "photo") for c in ("elephant", "horse")}
    assert store.factors["class"].classes == 2


def test_a_factor_that_never_changes_is_left_out_and_told(source, capsys):
    store = convert(source, domains="cartoon", classes="elephant")
    assert store.factors == {} and "classes" not in store.attributes and store.rows == 3
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 2
    assert "'domain' is always 'cartoon'" in lines[0] and "nothing can be measured" in lines[0]
    assert "'class' is always 'elephant'" in lines[1]
    assert set(convert(source, domains="cartoon").factors) == {"class"}


def test_hidden_names_and_other_files_are_no_pictures(source, capsys):
    before = convert(source).fingerprint
    (source / "__pycache__").mkdir()
    (source / "README.md").write_text("terms")
    (source / "art" / "dog" / "._pic_000.png").write_bytes(b"resource fork")
    (source / "art" / "dog" / "Thumbs.db").write_bytes(b"thumbs")
    (source / "art" / ".cache").mkdir()
    assert convert(source).fingerprint == before
    assert capsys.readouterr().err == ""


def test_combinations_without_a_picture_are_told(source, capsys):
    for file in (source / "photo" / "horse").iterdir():
        file.unlink()
    convert(source)
    assert "1 of 12 combinations have no picture: photo/horse" in capsys.readouterr().err


def test_what_is_left_out_is_not_read(source):
    (source / "art" / "dog" / "pic_001.png").write_bytes(b"no picture")
    message = refuse(source, "art/dog/pic_001.png: not a readable picture")
    assert "--leave_out art/dog/pic_001.png" in message and "archive" not in message
    assert convert(source, leave_out=" art/dog/pic_001.png,photo/dog/pic_000.png").rows == 34
    everything = ",".join(picture.key for picture in find_pictures(source, "art", "dog"))
    (source.parent / "out" / "store.h5").unlink()
    refuse(source, "no picture remains", domains="art", classes="dog", leave_out=everything)
    refuse(source, "leave_out", "did you mean 'art/dog/pic_001.png'", leave_out="art/dog/pic_01.png")


def test_the_damaged_picture_of_the_archive_is_known(tmp_path):
    source = write_tree(tmp_path / "PACS", domains=("photo", "sketch"))
    damaged = source / "sketch" / "dog" / "n02103406_4068-1.png"
    damaged.write_bytes((source / "sketch" / "dog" / "pic_000.png").read_bytes()[:50])
    message = refuse(source, "damaged in the published archive")
    assert f"pass --leave_out sketch/dog/{damaged.name}" in message


def test_folders_of_another_shape_are_refused_with_the_layout(tmp_path, source):
    layout = "SOURCE/<domain>/<class>/"
    refuse(tmp_path / "none", "none: no such folder", layout)
    (tmp_path / "empty").mkdir()
    refuse(tmp_path / "empty", "an empty folder", layout)
    refuse(source / "art" / "dog", "lie directly in it", layout)
    refuse(source / "art", "one level down", layout)
    refuse(source / "art" / "dog" / "pic_000.png", "is a file", layout)
    refuse(source.parent, "too deep", f"did you mean {source}?")
    (tmp_path / "hollow" / "a" / "b").mkdir(parents=True)
    refuse(tmp_path / "hollow", "holds no pictures", layout)
    (source / "splits").mkdir()
    refuse(source, "splits: holds no picture", "--domains")
    Image.new("RGB", (9, 9)).save(source / "photo" / "stray.png")
    refuse(source, "photo/stray.png: lies in no class folder", domains="photo")


def test_the_pictures_of_the_papers_demonstration_are_the_default(source, tmp_path):
    store = EpisodeStore(import_pacs(source, tmp_path / "elephants.h5", size=8, progress=False))
    assert store.rows == len(list((source / "cartoon" / "elephant").glob("*"))) and not store.factors
    (tmp_path / "mine" / "ink" / "cat").mkdir(parents=True)
    Image.new("RGB", (9, 9)).save(tmp_path / "mine" / "ink" / "cat" / "a.png")
    with pytest.raises(UserError, match=r"--domains: .* has no pictures of 'cartoon', choices: all, ink"):
        import_pacs(tmp_path / "mine", tmp_path / "mine.h5", progress=False)


def test_wrong_options_are_refused(source):
    refuse(source, "--domains is empty", domains=" , ")
    refuse(source, "domains", "'carton'", "did you mean 'cartoon'?", domains="art,carton")
    refuse(source, "classes", "'elefant'", "did you mean 'elephant'?", classes="elefant")
    for factors in ("domain", "a,a", "a,b,c", "a,", "a/b,c"):
        refuse(source, f"factors='{factors}'", factors=factors)
    for options in ({"size": 0}, {"seed": -1}, {"held_out": 1.0}, {"held_out": float("nan")}, {"held_out": -0.1}):
        refuse(source, "size must be at least 1, seed at least 0, held_out in [0, 1)", **options)


def test_an_existing_output_stays(source):
    path = convert(source).path
    before = path.read_bytes()
    with pytest.raises(UserError, match="exists already"):
        convert(source, overwrite=False)
    (source / "art" / "dog" / "pic_001.png").write_bytes(b"no picture")
    with pytest.raises(UserError, match="not a readable picture"):
        convert(source)
    assert path.read_bytes() == before and [p.name for p in path.parent.iterdir()] == ["store.h5"]


def test_jpeg_endings_in_any_case(tmp_path):
    source = write_tree(tmp_path / "a", ending="jpg")
    for number, file in enumerate(sorted(source.rglob("*.jpg"))):
        file.rename(file.with_suffix((".JPG", ".jpeg", ".jpg", ".Jpeg")[number % 4]))
    assert convert(source).rows == 12


def test_pictures_are_read_one_at_a_time(source, monkeypatch):
    """Memory stays flat: a picture is in the file before the next is decoded."""
    from repdib_lightning.data.importers import pacs

    events: list[str] = []
    read, add = pacs.read_square, pacs.EpisodeWriter.add_episode

    def told_read(*given: Any) -> Any:
        events.append("read")
        return read(*given)

    def told_add(writer: Any, **episode: Any) -> None:
        events.append("add")
        add(writer, **episode)

    monkeypatch.setattr(pacs, "read_square", told_read)
    monkeypatch.setattr(pacs.EpisodeWriter, "add_episode", told_add)
    convert(source)
    assert events == ["read", "add"] * 36
